"""Training states on disk: one .npz a state, written whole or not at all."""

import json
import os
import zipfile
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.lib import format as npy

from l2dgs_jax.config import EXECUTION, Config, from_dict, to_dict
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.files import replacing
from l2dgs_jax.training.initial_state import state_shapes
from l2dgs_jax.training.step import TrainState


class Checkpoint(NamedTuple):
    """A training state and the size of the pair buffer that it ran with, if it has run."""

    state: TrainState
    pair_capacity: int | None = None


def save(path: Path, checkpoint: Checkpoint, config: Config) -> None:
    """Write a state, one array after the other; a reader sees the old file or the new one.

    Raises:
        UserError: the file cannot be written.
    """
    leaves, _ = jax.tree_util.tree_flatten_with_path(checkpoint.state)
    header = json.dumps({"config": to_dict(config), "pair_capacity": checkpoint.pair_capacity})
    with replacing(path) as temporary, open(temporary, "wb") as file:
        with zipfile.ZipFile(file, "w") as archive:
            _write(archive, "header", np.array(header))
            for key, leaf in leaves:
                _write(archive, jax.tree_util.keystr(key), np.asarray(leaf))
        file.flush()
        os.fsync(file.fileno())


def load(path: Path, config: Config, num_frames: int) -> Checkpoint:
    """Read what `save` wrote, one array after the other, and none before all are known to fit.

    Args:
        path: the file.
        config: the settings that the checkpoint must have been written with, but for those in `EXECUTION`.
        num_frames: training frames of the scene.

    Raises:
        UserError: the file is missing, incomplete, or of other settings.
    """
    leaves, treedef = jax.tree_util.tree_flatten_with_path(state_shapes(config, num_frames))
    expected = {jax.tree_util.keystr(key): leaf for key, leaf in leaves}
    try:
        with zipfile.ZipFile(path) as archive:
            header = json.loads(str(_read(archive, "header")))
            written = to_dict(from_dict(header["config"]))  # with the defaults of settings that were added since
            difference = _first_difference(written, to_dict(config))
            if difference:
                raise UserError(f"{path}: written with other settings ({difference}); expected those of this run")
            misfit = next((name for name, leaf in expected.items() if not _fits(archive, name, leaf)), None)
            if misfit:
                raise UserError(
                    f"{path}: the array {misfit} is missing or has another shape; expected a checkpoint of this run"
                )
            arrays = (jnp.asarray(_read(archive, name)) for name in expected)
            return Checkpoint(jax.tree_util.tree_unflatten(treedef, arrays), header["pair_capacity"])
    except FileNotFoundError:
        raise UserError(f"{path}: no such checkpoint; expected one that train wrote") from None
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        raise UserError(f"{path}: truncated or not a checkpoint; expected a whole file that train wrote") from None


def _write(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
    """Add an array as `np.savez` does, which would want all of them at once."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        npy.write_array(file, array, allow_pickle=False)


def _read(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with archive.open(f"{name}.npy") as file:
        return npy.read_array(file, allow_pickle=False)


def _fits(archive: zipfile.ZipFile, name: str, leaf: jax.ShapeDtypeStruct) -> bool:
    """Whether an array is there and, as its header says, like `leaf` but for its number of rows and its precision."""
    if f"{name}.npy" not in archive.namelist():
        return False
    with archive.open(f"{name}.npy") as file:
        npy.read_magic(file)
        shape, _, dtype = npy.read_array_header_1_0(file)
    return (len(shape), shape[1:], dtype.kind) == (leaf.ndim, leaf.shape[1:], leaf.dtype.kind)


def _first_difference(saved: dict, expected: dict, prefix: str = "") -> str | None:
    for key in sorted((saved.keys() | expected.keys()) - EXECUTION):
        a, b = saved.get(key), expected.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            deeper = _first_difference(a, b, f"{prefix}{key}.")
            if deeper:
                return deeper
        elif a != b:
            return f"{prefix}{key} was {a}, is {b}"
    return None
