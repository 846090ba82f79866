"""NumPy arrays in nested dictionaries, as flax's users pickle parameters: nothing that a pickle may ask for is run."""

import io
import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.pickles import RefusedError, check_memo, refused

Arrays = dict[str, Shaped[np.ndarray, "..."]]


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
        stream = io.BytesIO(path.read_bytes())
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); expected pickled arrays") from None
    try:
        check_memo(stream)
        return _flat(_Unpickler(stream).load(), "")
    except RefusedError as refusal:
        raise UserError(f"{path}: {refusal}") from None
    except Exception:  # damaged pickles raise whatever their bytes lead to
        raise UserError(f"{path}: damaged or of another kind; expected a dictionary of pickled arrays") from None


class _Dtype:
    """Stands in for numpy.dtype: a number's kind and size, then its byte order."""

    def __init__(self, name: str, _align: bool, _copy: bool):
        if not re.fullmatch("[fiu][1248]|b1", name):
            raise RefusedError(f"holds elements of type {name[:20]!r}; expected numbers")
        self.name = name

    def __setstate__(self, state: tuple) -> None:
        self.name = f"{state[1]}{self.name}"


class _Array:
    """Stands in for numpy.ndarray, which pickle makes empty and then fills."""

    def __setstate__(self, state: tuple) -> None:
        _version, shape, dtype, by_column, content = state
        flat = np.frombuffer(content, np.dtype(dtype.name))
        self.value = flat.reshape(shape, order="F" if by_column else "C").copy()


def _reconstruct(_cls: type, _shape: tuple, _kind: bytes) -> _Array:
    return _Array()


class _Unpickler(pickle.Unpickler):
    """Builds dictionaries and arrays."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in (("numpy.core.multiarray", "_reconstruct"), ("numpy._core.multiarray", "_reconstruct")):
            return _reconstruct
        if (module, name) in (("numpy", "ndarray"), ("numpy", "dtype")):
            return _Array if name == "ndarray" else _Dtype
        raise refused(module, name, "plain arrays")


def _flat(tree: Any, name: str) -> Arrays:
    if isinstance(tree, _Array):
        return {name: tree.value}
    if not isinstance(tree, dict) or not all(isinstance(key, str) for key in tree):
        raise RefusedError("holds something else; expected dictionaries of arrays")
    return {
        place: array
        for key, branch in tree.items()
        for place, array in _flat(branch, f"{name}/{key}" if name else key).items()
    }
