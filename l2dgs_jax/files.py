"""Files that are written whole or not at all."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from l2dgs_jax.errors import UserError


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file beside `path` to write to; it takes the place of `path` if the block ends without an error.

    Raises:
        UserError: the folder is missing or not writable, or `path` is a folder.
    """
    if not path.parent.is_dir():
        raise UserError(f"{path}: cannot be written; expected an existing folder {path.parent}")
    if path.is_dir():
        raise UserError(f"{path}: is a folder; expected a file to write")
    temporary = path.with_name(f"{path.stem}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror}); expected a writable folder") from None
    finally:
        temporary.unlink(missing_ok=True)
