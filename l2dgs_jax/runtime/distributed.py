"""Several processes that train together on `jax.distributed`, with bounded waits and a sentence for every end."""

import contextlib
import os
import re
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import jax
from jax.experimental import multihost_utils

from l2dgs_jax.errors import Interrupted, UserError


@dataclass(frozen=True)
class Hosts:
    """Several processes, one on each host. All see the same files, and all are started with the same options but one.

    Attributes:
        coordinator: HOST:PORT of process 0, or JAX_COORDINATOR_ADDRESS; without either there is one process only.
        processes: how many there are, or JAX_NUM_PROCESSES.
        process: which one this is, from 0, or JAX_PROCESS_ID.
        timeout: seconds that the processes wait for each other when they start, end, or fall silent.
    """

    coordinator: str | None = None
    processes: int | None = None
    process: int | None = None
    timeout: int = 60


@contextlib.contextmanager
def process_group(hosts: Hosts) -> Iterator[None]:
    """Join the other processes, and part from them at the end; does nothing for one process.

    If the others are not found or lost, or if the block raises, the process ends at once with the reason on standard
    error, and exit code 2 unless what was raised has its own: it would wait for the others, or they for it.

    Raises:
        UserError: an option is missing or malformed.
    """
    address = hosts.coordinator or os.environ.get("JAX_COORDINATOR_ADDRESS")
    if address is None:
        yield
        return
    if not re.fullmatch(r"\S+:[0-9]{1,5}", address):
        raise UserError(f"--coordinator {address}: expected HOST:PORT of process 0")
    count = _number("--processes", hosts.processes, "JAX_NUM_PROCESSES")
    process = _number("--process", hosts.process, "JAX_PROCESS_ID")
    if not 0 <= process < count:
        raise UserError(f"--process {process}: expected a number from 0 to {count - 1}, below --processes")
    if hosts.timeout < 1:
        raise UserError(f"--timeout {hosts.timeout}: expected at least one second")
    alone = (
        f"--coordinator {address}: the {count} processes did not find each other within {hosts.timeout} s; expected "
        "all of them to be started with the same address, which process 0 can be reached at"
    )
    lost = (
        "this training has lost one of its processes, or the way to it; expected all of them to run to the end: start "
        "all again with --resume"
    )
    with _last_words() as prepare:
        prepare(alone)
        # Past its own limit jaxlib ends the process with a stack trace: ours comes first.
        patience = threading.Timer(hosts.timeout, _leave, [prepare, f"error: {alone}"])
        patience.daemon = True
        patience.start()
        jax.distributed.initialize(
            address,
            count,
            process,
            initialization_timeout=hosts.timeout + 30,
            heartbeat_timeout_seconds=max(hosts.timeout, 10),
            shutdown_timeout_seconds=hosts.timeout,
            cluster_detection_method="deactivate",
        )
        patience.cancel()
        prepare(lost)
        try:
            yield
        except UserError as error:
            _leave(prepare, f"error: {error}", error.code)
        except Interrupted as stop:
            _leave(prepare, str(stop), stop.code)
        except BaseException as error:
            # A broken connection comes as a ValueError too.
            if isinstance(error, jax.errors.JaxRuntimeError) or "Gloo" in str(error):
                _leave(prepare, f"error: {lost} ({str(error).splitlines()[0]})")
            _leave(prepare, f"error: {''.join(traceback.format_exception(error))}")
        jax.distributed.shutdown()


def barrier(name: str) -> None:
    """Wait until all processes have come to the barrier of that name."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(name)


def _number(option: str, value: int | None, variable: str) -> int:
    if value is not None:
        return value
    text = os.environ.get(variable, "")
    if not text.isdecimal():
        raise UserError(f"{option} is missing; expected a number, there or in {variable}, beside --coordinator")
    return int(text)


def _leave(prepare: Callable[[str], None], sentence: str, code: int = 2) -> None:
    """End at once: the usual end would wait for processes that may be gone."""
    prepare("")
    sys.stdout.flush()
    print(sentence, file=sys.stderr, flush=True)
    os._exit(code)


@contextlib.contextmanager
def _last_words() -> Iterator[Callable[[str], None]]:
    """A function that prepares the sentence to be printed if this process is ended from outside or by jaxlib.

    jaxlib ends a process whose coordinator is lost from a thread of its own, and Python never hears of it.
    """
    program = "import sys; last = sys.stdin.read().splitlines()[-1]; last and print('error:', last, file=sys.stderr)"
    command = [sys.executable, "-I", "-S", "-c", program]
    with subprocess.Popen(command, stdin=subprocess.PIPE, text=True, start_new_session=True) as witness:
        assert witness.stdin is not None
        pipe = witness.stdin

        def prepare(sentence: str) -> None:
            pipe.write(f"{sentence}\n")
            pipe.flush()

        try:
            yield prepare
        finally:
            prepare("")
            pipe.close()
