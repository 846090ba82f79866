"""Files and folders that are written whole or not at all."""

import contextlib
import errno
import json
import math
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from l2dgs_jax.errors import DISK_FULL, UserError

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # the disk or the user's quota is full, or the file too large


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file beside `path` to write to; it replaces `path` if the block ends without an error.

    If `path` is a symbolic link, it stays one, and the file that it leads to is replaced.

    Raises:
        UserError: the folder is missing or not writable, or `path` is a folder or a device.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f"{target.stem}.tmp{path.suffix}")
    try:
        if not target.parent.is_dir():
            raise UserError(f"{path}: cannot be written; expected an existing folder {path.parent}")
        if target.is_dir():
            raise UserError(f"{path}: is a folder; expected a file to write")
        if target.exists() and not target.is_file():
            raise UserError(f"{path}: is a device; expected a file to write")
        temporary.touch()  # a folder that is not writable is noticed before the work
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise unwritable(path, error) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def reserve(descriptor: int, size: int) -> None:
    """Reserve that many bytes for an open file, where the system can: a full disk is noticed before any is written.

    Raises:
        OSError: they do not fit onto the disk.
    """
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(descriptor, 0, size)


def append_line(path: Path, line: str) -> None:
    """Add a line to a file. After a crash its last line may be incomplete, which readers must tolerate.

    Raises:
        UserError: the file cannot be written.
    """
    try:
        with open(path, "a") as file:
            file.write(f"{line}\n")
    except OSError as error:
        raise unwritable(path, error) from None


def flush(path: Path) -> None:
    """Force a file, or a folder's list of entries, onto the disk, so that it survives a power cut."""
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def unwritable(path: Path, error: OSError) -> UserError:
    """The error to raise where the system refuses to write."""
    if error.errno in NO_ROOM:
        return UserError(f"{path}: cannot be written ({error.strerror}); expected more room", DISK_FULL)
    return UserError(f"{path}: cannot be written ({error.strerror}); expected a writable folder")


def make_folder(path: Path) -> None:
    """Create a folder and its parents, unless they exist.

    Raises:
        UserError: it cannot be created.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(path, error) from None


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A temporary folder beside `path` to fill; it becomes `path` if the block ends without an error.

    Raises:
        UserError: `path` exists and is not an empty folder, or cannot be written.
    """
    expect_new(path)
    target = path.resolve()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(
            dir=target.parent, prefix=f".{target.name}.", ignore_cleanup_errors=True
        ) as top:
            filled = Path(top) / target.name
            filled.mkdir()
            yield filled
            if target.exists():
                target.rmdir()
            os.rename(filled, target)
    except OSError as error:
        raise unwritable(path, error) from None


def write_json(path: Path, content: Any) -> None:
    """Write a JSON file (see `as_json`), whole or not at all, and create its folder.

    Raises:
        UserError: the folder cannot be created, or as `replacing`.
    """
    make_folder(path.parent)
    with replacing(path) as temporary:
        temporary.write_text(as_json(content, indent=2) + "\n")
        flush(temporary)


def as_json(content: Any, indent: int | None = None) -> str:
    """The content as JSON that every reader takes.

    Numbers that JSON lacks become the strings "Infinity", "-Infinity" and "NaN", as in the JSON of Protocol Buffers;
    Python's `float` reads them.
    """
    return json.dumps(_spelled_out(content), indent=indent, allow_nan=False)


def _spelled_out(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _spelled_out(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_spelled_out(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return json.dumps(content)  # writes these names, which are JavaScript's
    return content


def is_writable(folder: Path) -> bool:
    """Whether files can be created in a folder, which is created itself, with its parents, if it is missing."""
    place = folder.absolute()
    nearest = next(parent for parent in (place, *place.parents) if parent.exists())
    return nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)


def takes_file(path: Path) -> bool:
    """Whether `replacing` can write to `path`: no folder or device is there, and the folder around it takes files."""
    return path.parent.is_dir() and is_writable(path.parent) and (path.is_file() or not path.exists())


def is_taken(path: Path) -> bool:
    """Whether `path` exists and is not an empty folder."""
    return path.exists() and (not path.is_dir() or any(path.iterdir()))


def expect_new(path: Path) -> None:
    """Check early what `new_folder` requires of `path`.

    Raises:
        UserError: `path` exists and is not an empty folder.
    """
    if is_taken(path):
        raise UserError(f"{path}: exists already; expected a new or an empty folder to write to")
