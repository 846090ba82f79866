"""How much memory is in use, and one-sentence errors for running out of it."""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import jax

from l2dgs_jax.errors import OUT_OF_MEMORY, UserError

STATM = Path("/proc/self/statm")  # Linux: numbers of this process's memory pages, the resident ones second


def memory_in_use() -> int | None:
    """Bytes in use on the first device if it reports them, or else by this process; None if neither is known."""
    device = jax.local_devices()[0].memory_stats()
    if device:
        return device["bytes_in_use"]
    try:
        return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return None


@contextlib.contextmanager
def memory_errors(reached: Callable[[], str], expected: str) -> Iterator[None]:
    """Turn running out of memory, on the host or on a device, into a `UserError`.

    Args:
        reached: called on failure; says how far the work has come.
        expected: what would take less memory.

    Raises:
        UserError: the memory does not suffice.
    """
    try:
        yield
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise UserError(f"out of memory {reached()}; expected {expected}", OUT_OF_MEMORY) from None
