"""The server that shows a run to browsers."""

import contextlib
import io
import socket
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from l2dgs_jax.cameras import reframe
from l2dgs_jax.cameras.geometry import mean_up
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runtime.extras import extra
from l2dgs_jax.training.state import TrainState
from l2dgs_jax.viewer.guest import Guest
from l2dgs_jax.viewer.ladder import ladder
from l2dgs_jax.viewer.renderers import Renderers
from l2dgs_jax.viewer.stage import Stage
from l2dgs_jax.viewer.turns import Turns
from l2dgs_jax.visualize import films

USUAL_WINDOW = 1280, 720  # pixels
LONGEST_REST = 2.0  # seconds without rendering after a picture, while a training uses the processor


class Server(NamedTuple):
    """A running server.

    Attributes:
        port: where it listens.
        watched: returns whether any browser is connected.
        show: shows another state of the run from now on.
    """

    port: int
    watched: Callable[[], bool]
    show: Callable[[TrainState], None]


def check(host: str, port: int, prefix: str = "") -> None:
    """Check that a server can be started.

    Args:
        host: address to listen at.
        port: port to listen at.
        prefix: of the names of the options for these, for messages.

    Raises:
        UserError: viser is not installed, the port is invalid, listening at that address is not possible, or neither
            the port nor any above it is free.
    """
    extra("viser", "view", "viewing")
    if not 1 <= port <= 65535:
        raise UserError(f"--{prefix}port {port}: expected a number from 1 to 65535")
    what = "an address of this machine, or 0.0.0.0"
    if not host:  # which Python takes for all addresses
        raise UserError(f"--{prefix}host '': is empty; expected {what}")
    try:
        socket.create_server((host, 0)).close()
    except OSError as error:
        raise UserError(f"--{prefix}host {host}: {error.strerror}; expected {what}") from None
    if not any(_is_free(host, candidate) for candidate in range(port, 65536)):
        raise UserError(f"--{prefix}port {port}: is in use, and so are all above it; expected another port")


def _is_free(host: str, port: int) -> bool:
    try:
        socket.create_server((host, port)).close()
    except OSError:
        return False
    return True


@contextlib.contextmanager
def serve(run: Run, host: str, port: int, share: float = 1.0) -> Iterator[Server]:
    """Show a run to browsers for the length of the block.

    Every browser has its own camera, instant and light. One thread renders for all of them.

    Args:
        run: the run to show.
        host: address to listen at, see `check`.
        port: port to listen at, or the next free one.
        share: share of the time that rendering may take; rests between pictures are at most `LONGEST_REST`, so that it
            is exceeded if a picture takes long. Below 1, no larger sizes are compiled and pictures remain coarse.

    Yields:
        The server.
    """
    turns, guests, over = Turns(), dict[int, Guest](), threading.Event()

    def sharper_possible() -> None:
        for number in list(guests):
            turns.rest(number)

    renderers = Renderers(run, sharper_possible, growing=share == 1)
    trained, frame = run.dataset.train.cameras, (run.dataset.width, run.dataset.height)
    smallest = ladder(USUAL_WINDOW)[0]
    renderers.compile(smallest)
    ranges = films.sampled_ranges(run, reframe(trained, frame, smallest), ("b1", "b2", "depth"), smallest)
    stage = Stage.of(trained, np.asarray(run.dataset.points), frame)

    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
        server = extra("viser", "view", "viewing").ViserServer(host, port, label="l2dgs", verbose=False)
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    server.scene.set_up_direction(mean_up(np.asarray(trained.viewmat)))

    # As coroutines, these run in order; viser would run plain functions in threads.
    @server.on_client_connect
    async def _(client: Any) -> None:
        number = client.client_id
        guests[number] = Guest(client, run.dataset, stage, renderers, ranges, lambda: turns.ask(number))
        turns.ask(number)

    @server.on_client_disconnect
    async def _(client: Any) -> None:
        guests.pop(client.client_id, None)
        turns.leave(client.client_id)

    def show(state: TrainState) -> None:
        renderers.run = renderers.run.later(state)
        for number in list(guests):
            turns.ask(number)

    def draw() -> None:
        while turn := turns.take():
            guest, begun = guests.get(turn.guest), time.monotonic()
            try:
                if guest and guest.draw(turn.sharpen):
                    turns.rest(turn.guest)
            except Exception:  # a failed picture should not end the server
                traceback.print_exc()
            if share < 1:
                over.wait(min((time.monotonic() - begun) * (1 / share - 1), LONGEST_REST))

    thread = threading.Thread(target=draw, name="draw")
    thread.start()
    try:
        yield Server(server.get_port(), lambda: bool(guests), show)
    finally:
        over.set()
        turns.close()
        renderers.close()
        server.stop()
        thread.join()
