"""NumPy arrays in nested dictionaries, as flax's users pickle parameters: nothing that a pickle may ask for is run."""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.runtime.pickles import Arrays, follow
from l2dgs_jax.runtime.reading import RefusedError, read_file

_LONGEST_NAME = 256  # a long name would be repeated for every array below it


def load(path: Path) -> Arrays:
    """Read a pickled dictionary of arrays, or of such dictionaries.

    Args:
        path: the file, of protocol 3 or 4.

    Returns:
        The arrays in the file's order, each with memory of its own, by the keys that lead to it with / between them.

    Raises:
        UserError: the file is missing, damaged, or holds something else.
    """
    read = lambda content: _flat(follow(io.BytesIO(content), _NAMES, reusable=(_Type,)), "")
    return read_file(path, read, "a dictionary of pickled arrays")


class _Described:
    """What a pickle says of an object: the arguments that make it, and the state that completes it."""

    def __init__(self, *arguments: Any):
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Described):
    pass


class _Type(_Described):
    pass


_NAMES = {
    f"{module} {name}": stand_in
    for module in ("numpy", "numpy.core.multiarray", "numpy._core.multiarray")
    for name, stand_in in (("_reconstruct", _Array), ("dtype", _Type), ("ndarray", "an argument of _reconstruct"))
}


def _flat(tree: Any, name: str) -> Arrays:
    if isinstance(tree, _Array):
        return {name: _array(tree)}
    if not isinstance(tree, dict) or len(name) > _LONGEST_NAME:
        raise RefusedError("holds something else")
    return {
        place: array
        for key, branch in tree.items()
        for place, array in _flat(branch, f"{name}/{key}" if name else key).items()
    }


def _array(described: _Array) -> Shaped[np.ndarray, "..."]:
    _version, shape, dtype, by_column, content = described.state
    order = dtype.state[1]
    if not re.fullmatch("[<>|][fiub][1248]", f"{order}{dtype.arguments[0]}"):
        raise RefusedError("holds elements that are no numbers")
    flat = np.frombuffer(content, f"{order}{dtype.arguments[0]}")
    return flat.reshape(shape, order="F" if by_column else "C").copy()
