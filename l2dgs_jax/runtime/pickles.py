"""What is said of pickles that hold, or ask for, more than is supported."""


class RefusedError(Exception):
    """What a sound file holds that is not supported; the message lacks only the file's name."""


def refused(module: str, name: str, expected: str) -> RefusedError:
    """What is said of a pickle that asks for more than it is given."""
    return RefusedError(f"asks to load {f'{module}.{name}'[:80]!r}; expected {expected} only (nothing was run)")
