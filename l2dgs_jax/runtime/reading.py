"""Files that others made: what a reader makes of their bytes, or one sentence on why it makes nothing of them."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from l2dgs_jax.errors import UserError

T = TypeVar("T")


class RefusedError(Exception):
    """What a sound file holds that is not supported; the message lacks the file's name and what was expected."""


def read_file(path: Path, read: Callable[[bytes], T], expected: str) -> T:
    """What `read` makes of the bytes of a file.

    Args:
        path: the file.
        read: may raise anything.
        expected: what the file should hold, for messages.

    Raises:
        UserError: the file is missing, or `read` has raised something.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); expected {expected}") from None
    try:
        return read(content)
    except RefusedError as refusal:
        raise UserError(f"{path}: {refusal}; expected {expected}") from None
    except Exception:  # damaged files raise whatever their bytes lead to
        raise UserError(f"{path}: damaged or of another kind; expected {expected}") from None
