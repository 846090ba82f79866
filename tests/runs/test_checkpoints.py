"""Checkpoints: whole or refused, by one sentence."""

import dataclasses

import jax
import numpy as np
import pytest
from tiny_training import FRAMES, assert_equal_states, make_dataset, tiny

from l2dgs_jax.config import EXECUTION, to_dict
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs import checkpoints
from l2dgs_jax.runs.checkpoints import Checkpoint
from l2dgs_jax.training import initial_state


@pytest.fixture(scope="module")
def dataset():
    return make_dataset()


@pytest.mark.parametrize("damage", ["truncated", "text", "missing", "settings"])
def test_a_bad_checkpoint_is_one_clear_sentence(dataset, tmp_path, damage):
    config = tiny()
    path = tmp_path / "checkpoint.npz"
    checkpoints.save(path, Checkpoint(initial_state(dataset, config), 64), config)
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif damage == "text":
        path.write_text("not a checkpoint")
    elif damage == "missing":
        path.unlink()
    else:
        config = dataclasses.replace(config, batch_size=1)
    with pytest.raises(UserError, match=r"checkpoint\.npz: .*expected") as caught:
        checkpoints.load(path, config, FRAMES)
    assert "\n" not in str(caught.value)
    if damage == "settings":
        assert "batch_size was 2, is 1" in str(caught.value)


def test_a_checkpoint_is_an_npz_and_one_that_numpy_wrote_is_read(dataset, tmp_path):
    config, path = tiny(), tmp_path / "checkpoint.npz"
    state = initial_state(dataset, config)
    checkpoints.save(path, Checkpoint(state, 64), config)
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    assert list(arrays) == ["header", *(jax.tree_util.keystr(key) for key, _ in leaves)]
    np.savez(tmp_path / "numpy.npz", **arrays)
    for name in ("checkpoint.npz", "numpy.npz"):
        loaded, pair_capacity = checkpoints.load(tmp_path / name, config, FRAMES)
        assert pair_capacity == 64
        assert_equal_states(loaded, state)


@pytest.mark.parametrize("change", [None, lambda x: x[..., None], lambda x: x[:, :-1], lambda x: x > 0])
def test_no_array_is_read_before_all_are_known_to_fit(dataset, tmp_path, monkeypatch, change):
    config, path = tiny(), tmp_path / "checkpoint.npz"
    state = initial_state(dataset, config)
    checkpoints.save(path, Checkpoint(state, 64), config)
    with np.load(path) as file:
        arrays = dict(file)
    last = ".adam.nu.gaussians.means"
    changed = {} if change is None else {last: change(arrays[last])}
    np.savez(path, **{name: x for name, x in arrays.items() if name != last}, **changed)

    read, read_array = [], checkpoints.npy.read_array
    monkeypatch.setattr(
        checkpoints.npy, "read_array", lambda file, **k: read.append(file.name) or read_array(file, **k)
    )
    with pytest.raises(UserError, match=rf"the array {last} is missing or has another shape; expected"):
        checkpoints.load(path, config, FRAMES)
    assert read == ["header.npy"]


def test_how_a_run_is_carried_out_may_change_when_it_goes_on(dataset, tmp_path):
    config, path = tiny(), tmp_path / "checkpoint.npz"
    state = initial_state(dataset, config)
    checkpoints.save(path, Checkpoint(state, 64), config)
    assert set(to_dict(config)) > EXECUTION
    other = dataclasses.replace(config, checkpoint_every=7, frame_memory=0.0)
    assert_equal_states(checkpoints.load(path, other, FRAMES).state, state)
