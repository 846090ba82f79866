"""Named arrays from files of other programs: NumPy's .npz, or what PyTorch saved."""

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime import torch_pickle
from l2dgs_jax.runtime.pickles import Arrays
from l2dgs_jax.runtime.reading import read_file


def load(path: Path, expected: str) -> Arrays:
    """Read an .npz file, or a state_dict as torch.save writes it. No code that a file may contain is run.

    Args:
        path: the file.
        expected: what an .npz file should hold, for messages.

    Raises:
        UserError: the file is missing, damaged, or of another kind.
    """
    if path.suffix != ".npz":
        return torch_pickle.load(path)
    return read_file(path, _read_npz, expected)


def expect_floats(
    path: Path, arrays: Mapping[str, Shaped[np.ndarray, "..."]], name: str, shape: tuple[int, ...], expected: str
) -> Shaped[np.ndarray, "..."]:
    """One of a file's arrays, checked.

    Args:
        path: the file, for messages.
        arrays: all arrays of the file.
        name: of the array.
        shape: that the array must have.
        expected: what the file should hold, for messages.

    Raises:
        UserError: the array is missing, has another shape, or holds something else than finite floats.
    """
    if name not in arrays:
        raise UserError(f"{path}: '{name}' is missing; expected {expected}")
    array = arrays[name]
    if array.shape != shape or array.dtype.kind != "f" or not np.isfinite(array).all():
        raise UserError(
            f"{path}: '{name}' has shape {array.shape} and type {array.dtype}; expected {shape}, finite floats"
        )
    return array


def _read_npz(content: bytes) -> Arrays:
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return dict(file)
