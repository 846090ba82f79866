"""A training in the browser while it goes on, at little cost to it."""

import contextlib
import time
from collections.abc import Callable, Iterator

from l2dgs_jax.config import Config
from l2dgs_jax.data import Dataset
from l2dgs_jax.runs import previews
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runtime import devices
from l2dgs_jax.training import Progress
from l2dgs_jax.viewer.server import Server, serve

INTERVAL = 2.0  # seconds from one state that is shown to the next, at least
SHARE = 0.05  # of the time that drawing takes


@contextlib.contextmanager
def live(
    dataset: Dataset, config: Config, host: str, port: int, told: Callable[[int], None]
) -> Iterator[Callable[[Progress], None]]:
    """What shows the states of a training while the block is entered.

    Args:
        dataset: its scene.
        config: its settings, what they left to the data filled in.
        host: address to listen at, see `server.check`.
        port: to listen at, or the next that is free.
        told: called with the port once there is something to see.

    Yields:
        What to call after every step.
    """
    with contextlib.ExitStack() as stack:
        server: Server | None = None
        due = 0.0

        def on_step(progress: Progress) -> None:
            nonlocal server, due
            if progress.step <= previews.first(config) or time.monotonic() < due or (server and not server.watched()):
                return
            state = previews.with_last_capacity(devices.member(progress.states, 0), config)
            if server:
                server.show(state)
            else:
                server = stack.enter_context(serve(Run(config, dataset, state), host, port, SHARE))
                told(server.port)
            due = time.monotonic() + INTERVAL

        yield on_step
