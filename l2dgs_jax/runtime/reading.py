"""Reading files of other programs, with one-sentence errors for those that cannot be read."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from l2dgs_jax.errors import UserError

T = TypeVar("T")


class RefusedError(Exception):
    """An undamaged file holds something unsupported; the message lacks the file's name and what was expected."""


def read_file(path: Path, read: Callable[[bytes], T], expected: str) -> T:
    """The result of `read` for the bytes of a file.

    Args:
        path: the file.
        read: turns the bytes into a value; may raise anything.
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
    except Exception:  # damaged files can raise anything
        raise UserError(f"{path}: damaged or of another kind; expected {expected}") from None
