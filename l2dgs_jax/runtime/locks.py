"""Locks on folders, so that one process at a time works in each."""

import contextlib
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.files import unwritable

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

LOCK = "lock"


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder for the length of the block.

    It is a lock of the operating system, which releases it when the process ends, however that happens; the empty file
    `lock` only carries it. If the system or the file system does not support locks, a warning says so.

    Raises:
        UserError: another process holds the lock, or the folder cannot be written to.
    """
    path = folder / LOCK
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise unwritable(path, error) from None
    try:
        _lock(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, folder: Path) -> None:
    try:
        if fcntl is None:
            raise OSError("no locks on this system")
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UserError(f"{folder}: another process is training in it; expected that to end first") from None
    except OSError as error:
        reason = error.strerror or error
        message = f"{folder}: cannot be locked ({reason}): see to it that nothing else trains in it"
        warnings.warn(message, RuntimeWarning, stacklevel=4)
