"""Training states on disk: one .npz a state, written whole or not at all."""

import json
import os
import zipfile
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from l2dgs_jax.config import Config, to_dict
from l2dgs_jax.errors import UserError
from l2dgs_jax.files import replacing
from l2dgs_jax.step import TrainState


class Checkpoint(NamedTuple):
    """A training state and the size of the pair buffer that it ran with."""

    state: TrainState
    pair_capacity: int


def save(path: Path, checkpoint: Checkpoint, config: Config) -> None:
    """Write a state; a reader sees the old file or the new one.

    Raises:
        UserError: the file cannot be written.
    """
    leaves, _ = jax.tree_util.tree_flatten_with_path(checkpoint.state)
    arrays = {jax.tree_util.keystr(key): np.asarray(leaf) for key, leaf in leaves}
    header = json.dumps({"config": to_dict(config), "pair_capacity": checkpoint.pair_capacity})
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, header=np.array(header), **arrays)  # type: ignore[arg-type]
        file.flush()
        os.fsync(file.fileno())


def load(path: Path, config: Config, like: TrainState) -> Checkpoint:
    """Read what `save` wrote.

    Args:
        path: the file.
        config: the settings that the checkpoint must have been written with.
        like: a state of the same structure; the number of Gaussians may differ.

    Raises:
        UserError: the file is missing, incomplete, or of other settings.
    """
    leaves, treedef = jax.tree_util.tree_flatten_with_path(like)
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            header = json.loads(str(file["header"]))
            saved = header["config"]
            arrays = {name: file[name] for name in file.files if name != "header"}
    except FileNotFoundError:
        raise UserError(f"{path}: no such checkpoint; expected one that train wrote") from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        raise UserError(f"{path}: truncated or not a checkpoint; expected a whole file that train wrote") from None

    difference = _first_difference(saved, to_dict(config))
    if difference:
        raise UserError(f"{path}: written with other settings ({difference}); expected those of this run")
    names = [jax.tree_util.keystr(key) for key, _ in leaves]
    misfit = next((n for n, (_, leaf) in zip(names, leaves, strict=True) if _rank(arrays, n) != np.ndim(leaf)), None)
    if misfit:
        raise UserError(
            f"{path}: the array {misfit} is missing or has another shape; expected a checkpoint of this run"
        )
    state = jax.tree_util.tree_unflatten(treedef, [jnp.asarray(arrays[name]) for name in names])
    return Checkpoint(state, header["pair_capacity"])


def _rank(arrays: dict[str, np.ndarray], name: str) -> int | None:
    return arrays[name].ndim if name in arrays else None


def _first_difference(saved: dict, expected: dict, prefix: str = "") -> str | None:
    for key in sorted(saved.keys() | expected.keys()):
        a, b = saved.get(key), expected.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            deeper = _first_difference(a, b, f"{prefix}{key}.")
            if deeper:
                return deeper
        elif a != b:
            return f"{prefix}{key} was {a}, is {b}"
    return None
