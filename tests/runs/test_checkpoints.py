"""Checkpoints are read completely, or refused in one sentence."""

import dataclasses
import json
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_training import FRAMES, assert_equal_states, make_dataset, tiny

from l2dgs_jax.config import EXECUTION, to_dict
from l2dgs_jax.errors import DISK_FULL, UserError
from l2dgs_jax.runs import checkpoints
from l2dgs_jax.runs.checkpoints import Checkpoint
from l2dgs_jax.training import initial_state

try:
    import resource
except ImportError:  # Windows
    resource = None


@pytest.fixture(scope="module")
def dataset():
    return make_dataset()


@pytest.mark.parametrize("damage", ["truncated", "text", "missing", "settings"])
def test_an_unusable_checkpoint_is_refused_in_one_sentence(dataset, tmp_path, damage):
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
        loaded = checkpoints.load(tmp_path / name, config, FRAMES)
        assert loaded.pair_capacity == 64
        assert_equal_states(loaded.state, state)


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


def test_execution_settings_may_change_on_resuming(dataset, tmp_path):
    config, path = tiny(), tmp_path / "checkpoint.npz"
    state = initial_state(dataset, config)
    checkpoints.save(path, Checkpoint(state, 64), config)
    assert set(to_dict(config)) > EXECUTION
    other = dataclasses.replace(config, checkpoint_every=7, frame_memory=0.0, keep_checkpoints=1)
    assert_equal_states(checkpoints.load(path, other, FRAMES).state, state)


def rewrite_header(path, **header):
    """Rewrite a checkpoint with entries of its header changed; None removes one."""
    with np.load(path) as file:
        arrays = dict(file)
    facts = json.loads(str(arrays["header"])) | header
    arrays["header"] = np.array(json.dumps({name: fact for name, fact in facts.items() if fact is not None}))
    np.savez(path, **arrays)


def test_older_versions_are_read_and_later_ones_refused(dataset, tmp_path):
    config, path = tiny(), tmp_path / "checkpoint.npz"
    state = initial_state(dataset, config)
    checkpoints.save(path, Checkpoint(state, 64, halvings=2), config)
    assert checkpoints.load(path, config, FRAMES)[1:] == (64, 2)
    rewrite_header(path, version=None, halvings=None)  # as 0.1.0 wrote it
    old = checkpoints.load(path, config, FRAMES)
    assert old[1:] == (64, 0)
    assert_equal_states(old.state, state)
    rewrite_header(path, version=checkpoints.VERSION + 1, config={"nonsuch": 1})
    with pytest.raises(UserError, match=r"npz: of version 4; expected at most 3") as caught:
        checkpoints.load(path, config, FRAMES)
    assert not isinstance(caught.value, checkpoints.DamagedError)


class Bomb:
    """Creates a folder when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("exploded",)


@pytest.mark.parametrize("place", ["header", ".step"])
def test_nothing_in_a_checkpoint_is_executed(dataset, tmp_path, monkeypatch, place):
    monkeypatch.chdir(tmp_path)
    config, path = tiny(), tmp_path / "checkpoint.npz"
    checkpoints.save(path, Checkpoint(initial_state(dataset, config)), config)
    with np.load(path) as file:
        arrays = dict(file)
    bomb = np.empty((), object)
    bomb[()] = Bomb()
    np.savez(path, **arrays | {place: bomb})
    with pytest.raises(UserError, match=r"checkpoint\.npz: .*expected"):
        checkpoints.load(path, config, FRAMES)
    assert not (tmp_path / "exploded").exists()


def checkpoint_at(dataset, step):
    return Checkpoint(initial_state(dataset, tiny())._replace(step=jnp.int32(step)))


def steps_kept(path):
    return [int(checkpoints.load(file, tiny(), FRAMES).state.step) for file in checkpoints.kept(path)]


def test_the_last_few_checkpoints_are_kept(dataset, tmp_path):
    path = tmp_path / "checkpoint.npz"
    (tmp_path / "coarse.npz").touch()
    assert checkpoints.kept(path) == []
    for step, keep, expected in ((1, 3, [1]), (2, 3, [2, 1]), (3, 3, [3, 2, 1]), (4, 3, [4, 3, 2]), (5, 1, [5])):
        checkpoints.save(path, checkpoint_at(dataset, step), tiny(), keep)
        assert steps_kept(path) == expected
    assert sorted(file.name for file in tmp_path.iterdir()) == ["checkpoint.npz", "coarse.npz"]


def test_a_truncated_checkpoint_is_skipped_and_displaces_no_intact_one(dataset, tmp_path):
    path = tmp_path / "checkpoint.npz"
    for step in (1, 2):
        checkpoints.save(path, checkpoint_at(dataset, step), tiny(), 2)
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.warns(UserWarning, match=r"npz: truncated .*; checkpoint-1\.npz, of step 1, is used instead"):
        assert checkpoints.load_last(path, tiny(), FRAMES).state.step == 1
    checkpoints.save(path, checkpoint_at(dataset, 3), tiny(), 2)
    assert steps_kept(path) == [3, 1]
    assert checkpoints.load_last(path, tiny(), FRAMES, skip=1).state.step == 1
    assert checkpoints.load_last(path, tiny(), FRAMES, skip=9).state.step == 1
    for file in checkpoints.kept(path):
        file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(checkpoints.DamagedError, match=r"checkpoint\.npz: truncated"):
        checkpoints.load_last(path, tiny(), FRAMES)


def test_a_changed_byte_is_detected_or_does_not_matter(dataset, tmp_path):
    path = tmp_path / "checkpoint.npz"
    state = initial_state(dataset, tiny())
    checkpoints.save(path, Checkpoint(state, 64), tiny())
    content, rng, refused = path.read_bytes(), np.random.default_rng(0), 0
    for offset in rng.integers(0, len(content), 25):
        path.write_bytes(content[:offset] + bytes([content[offset] ^ 255]) + content[offset + 1 :])
        try:
            assert_equal_states(checkpoints.load(path, tiny(), FRAMES).state, state)
        except UserError:
            refused += 1
    assert refused > 12


@pytest.mark.skipif(resource is None, reason="the system has no limits")
def test_a_full_disk_leaves_the_previous_checkpoint(dataset, tmp_path):
    path = tmp_path / "checkpoint.npz"
    checkpoints.save(path, checkpoint_at(dataset, 1), tiny(), 2)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for room in (0, path.stat().st_size // 2, path.stat().st_size - 1):
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
        try:
            with pytest.raises(UserError, match=r"npz: cannot be written \(File too large\); expected") as caught:
                checkpoints.save(path, checkpoint_at(dataset, 2), tiny(), 2)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert caught.value.code == DISK_FULL
        assert steps_kept(path) == [1]
        assert [file.name for file in tmp_path.iterdir()] == [path.name]
