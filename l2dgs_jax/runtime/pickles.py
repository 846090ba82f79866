"""Reading pickled arrays without `pickle`: an interpreter of the few instructions that they need.

`pickle` itself can be made to exhaust the stack or the memory, even if it may load no classes.
"""

import io
import pickletools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.runtime.reading import RefusedError

Arrays = dict[str, Shaped[np.ndarray, "..."]]

_NUMBERS = ("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT")
_TEXTS = ("BINUNICODE", "SHORT_BINUNICODE", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES")
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
# How many values an instruction takes from the stack; those not listed take all since the last mark.
_OPERANDS = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3, "APPEND": 1, "SETITEM": 2, "STACK_GLOBAL": 2, "REDUCE": 2}
_LONGEST_REUSED = 64  # characters or bytes of a text that a pickle may refer to again


def follow(
    stream: io.BytesIO,
    names: Mapping[str, Any],
    reusable: tuple[type, ...] = (),
    persistent: Callable[[Any], Any] | None = None,
) -> Any:
    """The object that the next pickle of a stream describes; the stream is left after its end.

    It consists of dictionaries, lists, tuples, numbers, text and bytes, and of what `names` and `persistent` return.
    Only short text and values of the types in `reusable` may be referred to more than once: otherwise a small file
    could become a large object.

    Args:
        stream: holds the pickle, and possibly more after it.
        names: what stands in for each "module name" that the pickle may load. The pickle can call stand-ins that are
            functions or classes; it then passes the objects' states to their `__setstate__`.
        reusable: types of objects so made that the pickle may refer to more than once.
        persistent: returns what stands in for a persistent id; None if there may be no such ids.

    Raises:
        RefusedError: the pickle needs anything else.
        Exception: of any other type, if the pickle is damaged.
    """
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}

    def taken(instruction: str) -> list[Any]:
        count = _OPERANDS[instruction] if instruction in _OPERANDS else len(stack) - marks.pop()
        return [stack.pop() for _ in range(count)][::-1]

    argument: Any
    for opcode, argument, _ in pickletools.genops(stream):
        name = opcode.name
        match name:
            case "PROTO" | "FRAME" | "STOP":
                pass
            case _ if name in _NUMBERS or name in _TEXTS:
                stack.append(argument)
            case _ if name in _CONSTANTS:
                stack.append(_CONSTANTS[name])
            case "EMPTY_LIST":
                stack.append([])
            case "EMPTY_DICT":
                stack.append({})
            case "MARK":
                marks.append(len(stack))
            case "TUPLE" | "TUPLE1" | "TUPLE2" | "TUPLE3":
                stack.append(tuple(taken(name)))
            case "APPEND" | "APPENDS":
                values = taken(name)
                stack[-1].extend(values)
            case "SETITEM" | "SETITEMS":
                values = taken(name)
                stack[-1].update(dictionary(zip(values[::2], values[1::2], strict=True)))
            case "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "MEMOIZE":
                memo[len(memo)] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                value = memo[argument]
                short = isinstance(value, str | bytes) and len(value) <= _LONGEST_REUSED
                if not (short or callable(value) or isinstance(value, reusable)):
                    raise RefusedError("holds one value in two places")
                stack.append(value)
            case "GLOBAL" | "STACK_GLOBAL":
                asked = argument if name == "GLOBAL" else " ".join(taken(name))
                if asked not in names:
                    raise RefusedError(f"asks to load {asked.replace(' ', '.')[:80]!r} (nothing was run)")
                stack.append(names[asked])
            case "REDUCE":  # whatever is callable on the stack comes from `names`
                function, arguments = taken(name)
                stack.append(function(*arguments))
            case "BUILD":
                state = stack.pop()
                if not isinstance(stack[-1], dict):  # the state of an OrderedDict is only its attributes
                    stack[-1].__setstate__(state)
            case "BINPERSID" if persistent:
                stack.append(persistent(stack.pop()))
            case _:
                raise RefusedError("holds something else")
    (found,) = stack
    return found


def dictionary(items: Iterable[Any] = ()) -> dict[str, Any]:
    """A dictionary of pairs whose keys must be text: other keys could be nested too deep to be hashed."""
    pairs = [(key, value) for key, value in items]
    if not all(isinstance(key, str) for key, _ in pairs):
        raise RefusedError("holds something else")
    return dict(pairs)
