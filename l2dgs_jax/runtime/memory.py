"""Memory: how much is in use, and running out of it, said in one sentence."""

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import jax

from l2dgs_jax.errors import OUT_OF_MEMORY, UserError

STATISTICS = Path("/proc/self/statm")  # of Linux: pages of the process, the resident ones second


def memory_in_use() -> int | None:
    """Bytes: of the first device where devices keep account, or else of this process; None where nothing tells."""
    device = jax.local_devices()[0].memory_stats()
    if device:
        return device["bytes_in_use"]
    try:
        return int(STATISTICS.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return None


@contextlib.contextmanager
def memory_errors(reached: Callable[[], str], expected: str) -> Iterator[None]:
    """Turn running out of memory, of the host or of a device, into a sentence.

    Args:
        reached: how far the work has come, asked when it fails.
        expected: what would take less.

    Raises:
        UserError: the memory does not suffice.
    """
    try:
        yield
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise UserError(f"out of memory {reached()}; expected {expected}", OUT_OF_MEMORY) from None
