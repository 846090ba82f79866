"""Training by several processes with `jax.distributed`: waits are bounded, and every failure is one sentence."""

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
    """Training on several hosts, with one process each. All see the same files and get the same options but --process.

    Attributes:
        coordinator: HOST:PORT of process 0, for training on several hosts; JAX_COORDINATOR_ADDRESS if not given.
        processes: number of processes; JAX_NUM_PROCESSES if not given.
        process: index of this process, from 0; JAX_PROCESS_ID if not given.
        timeout: seconds that the processes wait for each other when they start or end, or when one does not respond.
    """

    coordinator: str | None = None
    processes: int | None = None
    process: int | None = None
    timeout: int = 60


@contextlib.contextmanager
def process_group(hosts: Hosts) -> Iterator[None]:
    """Connect to the other processes, and disconnect at the end; does nothing for a single process.

    If the others are not found or are lost, or if the block raises, the process ends at once, because it would wait for
    the others or they for it. The reason goes to standard error; the exit code is 2, or that of the exception.

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
    with _message_if_killed() as prepare:
        prepare(alone)
        # At its own limit jaxlib ends the process with a stack trace; this timer comes first.
        timer = threading.Timer(hosts.timeout, _exit_at_once, [prepare, f"error: {alone}"])
        timer.daemon = True
        timer.start()
        jax.distributed.initialize(
            address,
            count,
            process,
            initialization_timeout=hosts.timeout + 30,
            heartbeat_timeout_seconds=max(hosts.timeout, 10),
            shutdown_timeout_seconds=hosts.timeout,
            cluster_detection_method="deactivate",
        )
        timer.cancel()
        prepare(lost)
        try:
            yield
        except UserError as error:
            _exit_at_once(prepare, f"error: {error}", error.code)
        except Interrupted as stop:
            _exit_at_once(prepare, str(stop), stop.code)
        except BaseException as error:
            # A broken connection is sometimes raised as a ValueError.
            if isinstance(error, jax.errors.JaxRuntimeError) or "Gloo" in str(error):
                _exit_at_once(prepare, f"error: {lost} ({str(error).splitlines()[0]})")
            _exit_at_once(prepare, f"error: {''.join(traceback.format_exception(error))}")
        jax.distributed.shutdown()


def barrier(name: str) -> None:
    """Wait until all processes have reached the barrier of that name."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(name)


def _number(option: str, value: int | None, variable: str) -> int:
    if value is not None:
        return value
    text = os.environ.get(variable, "")
    if not text.isdecimal():
        raise UserError(f"{option} is missing; expected a number, there or in {variable}, beside --coordinator")
    return int(text)


def _exit_at_once(prepare: Callable[[str], None], sentence: str, code: int = 2) -> None:
    """End the process without cleaning up, which would wait for processes that may be gone."""
    prepare("")
    sys.stdout.flush()
    print(sentence, file=sys.stderr, flush=True)
    os._exit(code)


@contextlib.contextmanager
def _message_if_killed() -> Iterator[Callable[[str], None]]:
    """A function that sets the sentence to be printed if this process is killed or ended by jaxlib.

    jaxlib ends a process that has lost its coordinator from a thread of its own, without notice to Python. So a child
    process prints the sentence.
    """
    program = "import sys; last = sys.stdin.read().splitlines()[-1]; last and print('error:', last, file=sys.stderr)"
    command = [sys.executable, "-I", "-S", "-c", program]
    with subprocess.Popen(command, stdin=subprocess.PIPE, text=True, start_new_session=True) as child:
        assert child.stdin is not None
        pipe = child.stdin

        def prepare(sentence: str) -> None:
            pipe.write(f"{sentence}\n")
            pipe.flush()

        try:
            yield prepare
        finally:
            prepare("")
            pipe.close()
