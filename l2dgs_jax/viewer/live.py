"""Viewing a scene in the browser while it trains, at little cost to the training."""

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

LEAST_INTERVAL = 2.0  # seconds between states that are shown
RENDERING_SHARE = 0.05  # of the time


@contextlib.contextmanager
def live(
    dataset: Dataset, config: Config, host: str, port: int, told: Callable[[int], None]
) -> Iterator[Callable[[Progress], None]]:
    """Show the states of a training in the browser for the length of the block.

    Args:
        dataset: its scene.
        config: its settings, resolved by `training.resolve`.
        host: address to listen at, see `server.check`.
        port: port to listen at, or the next free one.
        told: called with the port once there is something to see.

    Yields:
        A function to call after every step.
    """
    with contextlib.ExitStack() as stack:
        server: Server | None = None
        due = 0.0

        def on_step(progress: Progress) -> None:
            nonlocal server, due
            if progress.step <= previews.first(config) or time.monotonic() < due or (server and not server.watched()):
                return
            state = devices.member(progress.states, 0)
            if server:
                server.show(state)
            else:
                server = stack.enter_context(serve(Run(config, dataset, state), host, port, RENDERING_SHARE))
                told(server.port)
            due = time.monotonic() + LEAST_INTERVAL

        yield on_step
