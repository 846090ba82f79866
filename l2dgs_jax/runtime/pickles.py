"""What pickles of untrusted files have in common: they are looked at before they are loaded."""

import io
import pickletools


class RefusedError(Exception):
    """What a sound file holds that is not supported; the message lacks only the file's name."""


def refused(module: str, name: str, expected: str) -> RefusedError:
    """What is said of a pickle that asks for more than it is given."""
    return RefusedError(f"asks to load {f'{module}.{name}'[:80]!r}; expected {expected} only (nothing was run)")


def check_memo(stream: io.BytesIO) -> None:
    """Look through the next pickle of a stream, and return to its start.

    Raises:
        ValueError: a memo index, which sizes a table in memory, is one that no file of this size can need.
    """
    start, size = stream.tell(), len(stream.getbuffer())
    for opcode, argument, _ in pickletools.genops(stream):
        if "PUT" in opcode.name and isinstance(argument, int) and argument > size:
            raise ValueError("a memo index beyond any that a file of this size can need")
    stream.seek(start)
