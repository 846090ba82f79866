"""Checkpoints on disk: one .npz file per training state, written whole or not at all; the last few are kept."""

import contextlib
import itertools
import json
import os
import re
import struct
import warnings
import zipfile
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.lib import format as npy

from l2dgs_jax.config import EXECUTION, Config, from_dict, to_dict
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.files import flush, replacing
from l2dgs_jax.training.initial_state import state_shapes
from l2dgs_jax.training.state import TrainState

_STEP, _ALIVE, _PATH_OF = ".step", ".scene.alive", ".scene.path_of"  # names of arrays in a file, by their place
# Of the file format: files of version 1 have no version and no halvings; before 3, each Gaussian had a path of its own.
VERSION = 3

# Exceptions that reading zip, npy and JSON raises for damaged files.
DAMAGE_ERRORS = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    EOFError,
    NotImplementedError,
    RuntimeError,
    struct.error,
    zipfile.BadZipFile,
)


class DamagedError(UserError):
    """A file is damaged or is not a checkpoint."""


class Checkpoint(NamedTuple):
    """The state of a training, and what else it takes to resume it.

    Attributes:
        state: the training state.
        pair_capacity: size of the rasterizer's pair buffer in the last step; None before the first.
        halvings: how often the learning rates were halved because the training diverged.
    """

    state: TrainState
    pair_capacity: int | None = None
    halvings: int = 0


def save(path: Path, checkpoint: Checkpoint, config: Config, keep: int = 1) -> None:
    """Write a checkpoint array by array; it is flushed to the disk before it replaces the previous one.

    Args:
        path: the file.
        checkpoint: what to write.
        config: the settings of the training.
        keep: how many checkpoints to keep, this one included; see `kept`.

    Raises:
        UserError: the file cannot be written.
    """
    leaves, _ = jax.tree_util.tree_flatten_with_path(checkpoint.state)
    facts = {"version": VERSION, "pair_capacity": checkpoint.pair_capacity, "halvings": checkpoint.halvings}
    header = json.dumps(facts | {"config": to_dict(config)})
    with replacing(path) as temporary:
        with zipfile.ZipFile(temporary, "w") as archive:
            _write(archive, "header", np.array(header))
            for key, leaf in leaves:
                _write(archive, jax.tree_util.keystr(key), np.asarray(leaf))
        flush(temporary)
        _make_way(path, keep)
    with contextlib.suppress(OSError):  # some systems cannot flush folders
        flush(path.parent)


def kept(path: Path) -> list[Path]:
    """The existing checkpoints, newest first: checkpoint.npz, checkpoint-1.npz, checkpoint-2.npz ..."""
    name = re.compile(rf"{re.escape(path.stem)}-(\d+){re.escape(path.suffix)}")
    earlier = {int(found[1]): file for file in path.parent.glob("*") if (found := name.fullmatch(file.name))}
    return [*([path] if path.exists() else []), *(file for _, file in sorted(earlier.items()))]


def drop_after(path: Path, step: int) -> None:
    """Remove the checkpoints of later steps than `step`; damaged files stay.

    Args:
        path: file of the last checkpoint.
        step: number of finished steps.
    """
    for file in kept(path):
        try:
            with zipfile.ZipFile(file) as archive:
                later = _read(archive, _STEP) > step
        except DAMAGE_ERRORS:
            continue
        if later:
            file.unlink()


def load_last(path: Path, config: Config, num_frames: int, skip: int = 0) -> Checkpoint:
    """Read the last undamaged checkpoint; warns about each damaged one after it.

    Args:
        path: file of the last checkpoint.
        config: see `load`.
        num_frames: see `load`.
        skip: number of the latest checkpoints to skip; the oldest one is never skipped.

    Raises:
        UserError: all are damaged, or as `load`.
    """
    files, damaged = kept(path) or [path], []
    for file in files[min(skip, len(files) - 1) :]:
        try:
            checkpoint = load(file, config, num_frames)
        except DamagedError as error:
            damaged.append(error)
        else:
            for damage in damaged:
                warnings.warn(f"{damage}; {file.name}, of step {checkpoint.state.step}, is used instead", stacklevel=2)
            return checkpoint
    raise damaged[0]


def load(path: Path, config: Config, num_frames: int) -> Checkpoint:
    """Read what `save` wrote, array by array, after the headers of all arrays have been checked.

    Args:
        path: the file.
        config: the settings that the checkpoint must have been written with, except those in `EXECUTION`.
        num_frames: number of training frames of the scene.

    Raises:
        UserError: the file is missing, was written with other settings, or has a later version.
        DamagedError: the file is damaged or is not a checkpoint.
    """
    leaves, treedef = jax.tree_util.tree_flatten_with_path(state_shapes(config, num_frames))
    expected = {jax.tree_util.keystr(key): leaf for key, leaf in leaves}
    try:
        with zipfile.ZipFile(path) as archive:
            header = json.loads(str(_read(archive, "header")))
            version = header.get("version", 1)
            if version > VERSION:
                raise UserError(
                    f"{path}: of version {version}; expected at most {VERSION}: a newer l2dgs_jax has written it"
                )
            check_settings(path, from_dict(header["config"]), config)
            sources = {name: _source(name, version) for name in expected if version >= 3 or name != _PATH_OF}
            misfit = next((s for name, s in sources.items() if not _fits(archive, s, expected[name])), None)
            if misfit:
                raise UserError(
                    f"{path}: the array {misfit} is missing or has another shape; expected a checkpoint of this run"
                )
            one_by_one = lambda: np.arange(len(_read(archive, _ALIVE)), dtype=np.int32)  # for _PATH_OF
            read = lambda name: _read(archive, sources[name]) if name in sources else one_by_one()
            arrays = (jnp.asarray(read(name)) for name in expected)
            state = jax.tree_util.tree_unflatten(treedef, arrays)
            return Checkpoint(state, header["pair_capacity"], header.get("halvings", 0))
    except FileNotFoundError:
        raise UserError(f"{path}: no such checkpoint; expected one that train wrote") from None
    except jax.errors.JaxRuntimeError:  # out of memory
        raise
    except DAMAGE_ERRORS:
        raise DamagedError(f"{path}: truncated or not a checkpoint; expected a whole file that train wrote") from None


def check_settings(path: Path, written: Config, config: Config) -> None:
    """Check that a file was written with the settings of a training, except those in `EXECUTION`.

    Args:
        path: the file.
        written: its settings, completed by the defaults of settings added since.
        config: the settings of the training.

    Raises:
        UserError: they differ.
    """
    difference = _first_difference(to_dict(written), to_dict(config))
    if difference:
        raise UserError(f"{path}: written with other settings ({difference}); expected those of this run")


def _make_way(path: Path, keep: int) -> None:
    """Rename the checkpoints that are kept, each one place back, and remove the others."""
    places = [path, *(path.with_name(f"{path.stem}-{index}{path.suffix}") for index in range(1, keep))]
    for later, earlier in reversed(list(itertools.pairwise(places))):
        if zipfile.is_zipfile(later):  # a truncated file should not replace an intact one
            os.replace(later, earlier)
    for file in kept(path):
        if file not in places:
            file.unlink()


def _write(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> None:
    """Add an array in the format of `np.savez`, which would need all of them in memory at once."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
        npy.write_array(file, array, allow_pickle=False)


def _read(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with archive.open(f"{name}.npy") as file:
        return npy.read_array(file, allow_pickle=False)


def _source(name: str, version: int) -> str:
    """What an array is called in a file of that version."""
    place, _, last = name.rpartition(".")
    return f"{place}.gaussians.paths" if version < 3 and last == "paths" else name


def _fits(archive: zipfile.ZipFile, name: str, leaf: jax.ShapeDtypeStruct) -> bool:
    """Whether an array exists and, by its header, is like `leaf` except for the number of rows and the precision."""
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
