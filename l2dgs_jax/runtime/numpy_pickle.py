"""NumPy arrays in nested dictionaries, as flax's users pickle parameters: nothing that a pickle may ask for is run.

The few instructions that such a file needs are followed here, not by `pickle`, which even with no classes at hand can
be led to exhaust the stack or the memory.
"""

import pickletools
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.pickles import RefusedError, refused

Arrays = dict[str, Shaped[np.ndarray, "..."]]

_MODULES = ("numpy", "numpy.core.multiarray", "numpy._core.multiarray")
_NAMES = ("_reconstruct", "ndarray", "dtype")
_IGNORED = ("PROTO", "FRAME", "STOP")
_LITERALS = ("BINUNICODE", "SHORT_BINUNICODE", "BINBYTES", "SHORT_BINBYTES", "BININT", "BININT1", "BININT2", "LONG1")
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_REUSED = 64  # characters or bytes of what a file may mention again instead of writing it twice


def load(path: Path) -> Arrays:
    """Read a pickled dictionary of arrays, or of such dictionaries.

    Args:
        path: the file, of protocol 3 or 4.

    Returns:
        The arrays in the file's order, each with memory of its own, by the keys that lead to it with / between them.

    Raises:
        UserError: the file is missing, damaged, or holds something else.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); expected pickled arrays") from None
    try:
        return _flat(_followed(content), "")
    except RefusedError as refusal:
        raise UserError(f"{path}: {refusal}") from None
    except Exception:  # damaged pickles raise whatever their bytes lead to
        raise UserError(f"{path}: damaged or of another kind; expected a dictionary of pickled arrays") from None


class _Name(NamedTuple):
    """What a file mentions by name, and never gets."""

    name: str


class _Made:
    """What is made by calling a name: an empty array or a type, completed by its state."""

    def __init__(self, name: str, arguments: tuple):
        self.name, self.arguments = name, arguments
        self.state: tuple = ()


def _followed(content: bytes) -> Any:
    """What the pickle describes, of dictionaries, tuples, numbers, text, bytes and `_Made`."""
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}

    def since_mark() -> list[Any]:
        start = marks.pop()
        rest = stack[start:]
        del stack[start:]
        return rest

    argument: Any
    for opcode, argument, _ in pickletools.genops(content):
        name = opcode.name
        if name in _IGNORED:
            continue
        if name in _LITERALS:
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name == "EMPTY_DICT":
            stack.append({})
        elif name == "MARK":
            marks.append(len(stack))
        elif name == "TUPLE":
            rest = since_mark()
            stack.append(tuple(rest))
        elif name in _TUPLES:
            rest = [stack.pop() for _ in range(_TUPLES[name])]
            stack.append(tuple(reversed(rest)))
        elif name in ("BINPUT", "LONG_BINPUT"):
            memo[argument] = stack[-1]
        elif name == "MEMOIZE":
            memo[len(memo)] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(_reused(memo[argument]))
        elif name in ("GLOBAL", "STACK_GLOBAL"):
            module, asked = argument.split(" ") if name == "GLOBAL" else (stack.pop(-2), stack.pop())
            if module not in _MODULES or asked not in _NAMES:
                raise refused(module, asked, "plain arrays")
            stack.append(_Name(asked))
        elif name == "REDUCE":
            arguments = stack.pop()
            stack.append(_Made(stack.pop().name, arguments))
        elif name == "BUILD":
            state = stack.pop()
            stack[-1].state = state
        elif name in ("SETITEM", "SETITEMS"):
            items = [stack.pop(-2), stack.pop()] if name == "SETITEM" else since_mark()
            for key, value in zip(items[::2], items[1::2], strict=True):
                if not isinstance(key, str):
                    raise RefusedError("holds something else; expected dictionaries of arrays")
                stack[-1][key] = value
        else:
            raise RefusedError("holds something else; expected dictionaries of arrays")
    (found,) = stack
    return found


def _reused(value: Any) -> Any:
    """A value that is mentioned again: never one that could make a small file a large one."""
    small = isinstance(value, str | bytes) and len(value) <= _REUSED
    if small or isinstance(value, _Name) or (isinstance(value, _Made) and value.name == "dtype"):
        return value
    raise ValueError("a value in two places")


def _flat(tree: Any, name: str) -> Arrays:
    if isinstance(tree, _Made):
        return {name: _array(tree)}
    if not isinstance(tree, dict):
        raise RefusedError("holds something else; expected dictionaries of arrays")
    return {
        place: array
        for key, branch in tree.items()
        for place, array in _flat(branch, f"{name}/{key}" if name else key).items()
    }


def _array(made: _Made) -> Shaped[np.ndarray, "..."]:
    _version, shape, dtype, by_column, content = made.state
    order = dtype.state[1]
    if not re.fullmatch("[<>|][fiub][1248]", f"{order}{dtype.arguments[0]}"):
        raise RefusedError("holds elements of another type; expected numbers")
    flat = np.frombuffer(content, f"{order}{dtype.arguments[0]}")
    return flat.reshape(shape, order="F" if by_column else "C").copy()
