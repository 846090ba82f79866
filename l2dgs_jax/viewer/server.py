"""A run in the browser."""

import contextlib
import io
import socket
import threading
import traceback
from collections.abc import Iterator
from typing import Any

import numpy as np

from l2dgs_jax.cameras import reframe
from l2dgs_jax.cameras.geometry import mean_up
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runtime.extras import extra
from l2dgs_jax.viewer.guest import Guest
from l2dgs_jax.viewer.ladder import ladder
from l2dgs_jax.viewer.renderers import Renderers
from l2dgs_jax.viewer.stage import Stage
from l2dgs_jax.viewer.turns import Turns
from l2dgs_jax.visualize import films

USUAL_WINDOW = 1280, 720  # pixels


@contextlib.contextmanager
def serve(run: Run, host: str, port: int) -> Iterator[int]:
    """Show a run to browsers while the block is entered.

    Every browser has its own camera, instant and light. One thread draws for all of them.

    Args:
        run: what to show.
        host: address to listen at.
        port: to listen at, or the next that is free.

    Yields:
        The port.

    Raises:
        UserError: viser is not installed, or there is no listening at that address.
    """
    library = extra("viser", "view", "viewing")
    _check_address(host)
    turns, guests = Turns(), dict[int, Guest]()

    def sharper_possible() -> None:
        for number in list(guests):
            turns.rest(number)

    renderers = Renderers(run, sharper_possible)
    trained, frame = run.dataset.train.cameras, (run.dataset.width, run.dataset.height)
    smallest = ladder(USUAL_WINDOW)[0]
    renderers.compile(smallest)
    ranges = films.sampled_ranges(run, reframe(trained, frame, smallest), ("b1", "b2", "depth"), smallest)
    stage = Stage.of(trained, np.asarray(run.dataset.points), frame)

    with contextlib.redirect_stdout(io.StringIO()):  # it introduces itself
        server = library.ViserServer(host, port, label="l2dgs", verbose=False)
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    server.scene.set_up_direction(mean_up(np.asarray(trained.viewmat)))

    # Coroutines come and go in order; functions would run in threads.
    @server.on_client_connect
    async def _(client: Any) -> None:
        number = client.client_id
        guests[number] = Guest(client, run.dataset, stage, renderers, ranges, lambda: turns.ask(number))
        turns.ask(number)

    @server.on_client_disconnect
    async def _(client: Any) -> None:
        guests.pop(client.client_id, None)
        turns.leave(client.client_id)

    def draw() -> None:
        while turn := turns.take():
            guest = guests.get(turn.guest)
            try:
                if guest and guest.draw(turn.sharpen):
                    turns.rest(turn.guest)
            except Exception:  # a picture that fails is no reason to stop showing others
                traceback.print_exc()

    thread = threading.Thread(target=draw, name="draw")
    thread.start()
    try:
        yield server.get_port()
    finally:
        turns.close()
        renderers.close()
        server.stop()
        thread.join()


def _check_address(host: str) -> None:
    try:
        socket.create_server((host, 0)).close()
    except OSError as error:
        raise UserError(f"--host {host}: {error.strerror}; expected an address of this machine, or 0.0.0.0") from None
