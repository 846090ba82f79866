"""`python -m l2dgs_jax.view RUN`: fly through a run in the browser."""

import socket
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from l2dgs_jax.runs import open_run
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.signals import stop_requests
from l2dgs_jax.viewer import serve
from l2dgs_jax.viewer.server import check


@dataclass(frozen=True)
class View:
    """Fly through a run in the browser, until Ctrl-C.

    Attributes:
        run: folder of the run.
        host: address to listen at; 0.0.0.0 admits every machine on the network.
        port: port to listen at, or the next free one.
        stage: the last checkpoint ("final"), or the one at the end of the coarse stage ("coarse").
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    host: str = "127.0.0.1"
    port: int = 8080
    stage: Literal["final", "coarse"] = "final"


def main(arguments: Sequence[str]) -> None:
    """Serve as the command line says."""
    options = command_line.parse(View, arguments, "view")
    check(options.host, options.port)
    run = open_run(options.run, options.stage)
    print(f"preparing {options.run}", flush=True)
    with serve(run, options.host, options.port) as server:
        print(f"open http://{options.host}:{server.port} in a browser; Ctrl-C ends it")
        tunnel = f"ssh -L {server.port}:{options.host}:{server.port} {socket.gethostname()}"
        print(f"from another machine: {tunnel}", flush=True)
        until_stopped()


def until_stopped() -> None:
    """Wait for SIGINT, which is Ctrl-C, or SIGTERM."""
    asked = threading.Event()
    with stop_requests(asked.set):
        asked.wait()


if __name__ == "__main__":
    command_line.run(main, huge_pages=True)
