"""Pickled nested dictionaries of NumPy arrays, as flax's users save parameters; no code in a pickle is run."""

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.runtime.pickles import Arrays, follow
from l2dgs_jax.runtime.reading import RefusedError, read_file

_LONGEST_NAME = 256  # characters; a longer name would be repeated for every array below it


def load(path: Path) -> Arrays:
    """Read a pickled dictionary whose values are arrays or, again, such dictionaries.

    Args:
        path: the file, of protocol 3 or 4.

    Returns:
        The arrays in the file's order, each with memory of its own, by their keys joined with /.

    Raises:
        UserError: the file is missing, damaged, or holds something else.
    """
    read = lambda content: _flat(follow(io.BytesIO(content), _STAND_INS, reusable=(_Type,)), "")
    return read_file(path, read, "a dictionary of pickled arrays")


class _Described:
    """Stands in for an object of a pickle: the arguments of its constructor, and its state."""

    def __init__(self, *arguments: Any):
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Described):
    pass


class _Type(_Described):
    pass


_STAND_INS = {
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
