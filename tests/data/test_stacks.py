"""Frames that do not fit into memory are read from a file: same values, one frame in memory at a time."""

import tempfile
from pathlib import Path

import jax
import numpy as np
import pytest
from scenes import write_nerfies

from l2dgs_jax import data
from l2dgs_jax.config import PRESETS
from l2dgs_jax.data.stacks import MappedArray, evenly_spread, nan_median, pixel_mean, stacked
from l2dgs_jax.errors import UserError
from l2dgs_jax.model.observation import observed_colors
from l2dgs_jax.training import resolve
from l2dgs_jax.training.batching import load_batch

STATUS = Path("/proc/self/status")


def frames(count=5, seed=0):
    return np.random.default_rng(seed).random((count, 4, 6, 3)).astype(np.float16)


@pytest.fixture
def temporary_folder(tmp_path, monkeypatch):
    """The folder for temporary files."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("in_file", [False, True])
def test_a_stack_holds_its_frames(in_file):
    expected = frames()
    stack = stacked(iter(expected), expected.shape, np.float16, in_file)
    assert isinstance(stack, MappedArray) == in_file
    np.testing.assert_array_equal(stack, expected)
    np.testing.assert_array_equal(list(stack), expected)
    for key in (2, -1, [3, 1], slice(1, 4), (slice(None), slice(1, 3)), (0, 1, 2, 0), np.array([0, 0])):
        np.testing.assert_array_equal(stack[key], expected[key])
        assert type(stack[key]) is type(expected[key])
    empty = stacked(iter([]), (0, 4, 6, 3), np.float16, in_file)
    assert empty.shape == (0, 4, 6, 3)


@pytest.mark.parametrize("in_file", [False, True])
@pytest.mark.parametrize("count", [4, 6])
def test_a_stack_refuses_too_few_or_too_many_frames(in_file, count):
    with pytest.raises(ValueError, match="zip"):
        stacked(iter(frames()), (count, 4, 6, 3), np.float16, in_file)


def test_a_stack_in_a_file_is_read_only_and_leaves_no_file_behind(temporary_folder):
    stack = stacked(iter(frames()), (5, 4, 6, 3), np.float16, in_file=True)
    assert not list(temporary_folder.iterdir())
    with pytest.raises(ValueError, match="read-only"):
        stack[0] = 0
    stack[0][:] = 0  # a copy
    np.testing.assert_array_equal(stack, frames())


@pytest.mark.skipif(not STATUS.exists(), reason="tells resident pages of files on Linux only")
def test_pages_of_frames_that_were_read_leave_memory():
    def resident():
        """MiB of files that are mapped and in memory."""
        return int(next(x for x in STATUS.read_text().splitlines() if x.startswith("RssFile")).split()[1]) / 1024

    frame = np.ones((1 << 20,), np.float32)
    stack = stacked((frame for _ in range(32)), (32, 1 << 20), np.float32, in_file=True)
    before = resident()
    assert sum(float(frame.sum()) for frame in stack) == 32 * 2**20
    assert resident() - before < 16
    assert stack.view(np.ndarray).sum() == 32 * 2**20  # a plain view keeps what it reads
    assert resident() - before > 100


def test_pixel_mean_is_over_valid_pixels():
    images, valid = frames(), np.random.default_rng(1).random((5, 4, 6)) < 0.5
    in_file = stacked(iter(images), images.shape, images.dtype, in_file=True)
    for stack in (images, in_file):
        np.testing.assert_allclose(pixel_mean(stack), images.mean((0, 1, 2), np.float64), rtol=1e-12)
        expected = images.mean((0, 1, 2), np.float64, where=valid[..., None])
        np.testing.assert_allclose(pixel_mean(stack, valid), expected, rtol=1e-12)
    np.testing.assert_allclose(pixel_mean(valid, images[..., 0] > 0.5), valid[images[..., 0] > 0.5].mean())


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    lens = {"radial_distortion": [0.5, 0.0, 0.0]}  # some pixels are not valid
    return write_nerfies(tmp_path_factory.mktemp("scene"), truth=True, **lens)


def test_a_scene_larger_than_frame_memory_has_the_same_values(scene, temporary_folder):
    memory, file = data.load_dataset(scene), data.load_dataset(scene, frame_memory=0.0)
    assert not list(temporary_folder.iterdir())
    for kept, streamed in ((memory.train, file.train), (memory.test, file.test)):
        for name in ("images", "welllit", "masks", "valid"):
            a, b = getattr(kept, name), getattr(streamed, name)
            assert not isinstance(a, MappedArray), name
            assert isinstance(b, MappedArray), name
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
    assert not memory.train.valid.all()

    config = resolve(PRESETS["demo"], memory)
    assert resolve(PRESETS["demo"], file) == config
    seen, batches = [], []
    for dataset in (memory, file):
        train = dataset.train
        seen.append(observed_colors(dataset.points, train.cameras, train.images, train.valid))
        batches.append(load_batch(train, np.array([3, 1])))
    np.testing.assert_array_equal(*seen)
    for x, y in zip(*map(jax.tree.leaves, batches), strict=True):
        np.testing.assert_array_equal(x, y)


def test_frame_memory_counts_the_frames_of_both_splits_and_the_truth(scene):
    gib = 2 * 8 * 24 * 32 * 3 * 2 / 2**30
    assert not isinstance(data.load_dataset(scene, frame_memory=1.01 * gib).train.images, MappedArray)
    assert isinstance(data.load_dataset(scene, frame_memory=0.99 * gib).train.images, MappedArray)


@pytest.mark.parametrize("memory", [-1.0, float("nan")])
def test_an_invalid_frame_memory_is_refused(scene, memory):
    with pytest.raises(UserError, match=rf"--frame-memory {memory}: expected GiB, from 0"):
        data.load_dataset(scene, frame_memory=memory)


def test_a_full_disk_is_reported_in_one_sentence(scene, temporary_folder, monkeypatch):
    sentence = "cannot hold 2.6e-05 GiB of frames (No space left on device); expected TMPDIR to name a writable folder"

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    for fails in ("os.posix_fallocate", "mmap.mmap"):
        with monkeypatch.context() as patch:
            patch.setattr(fails, full, raising=False)
            with pytest.raises(UserError) as caught:
                data.load_dataset(scene, frame_memory=0.0)
        assert str(caught.value).startswith(f"{temporary_folder}: {sentence}")
    monkeypatch.setattr(tempfile, "tempdir", str(temporary_folder / "nonsuch"))
    with pytest.raises(UserError, match=r"nonsuch: cannot hold .* expected TMPDIR"):
        data.load_dataset(scene, frame_memory=0.0)


def test_indices_are_evenly_spread():
    assert evenly_spread(0, 3).tolist() == []
    assert evenly_spread(2, 3).tolist() == [0, 1]
    assert evenly_spread(10, 4).tolist() == [0, 3, 6, 9]


def test_nan_median_is_that_of_numpy():
    rng = np.random.default_rng(0)
    values = np.where(rng.random((7, 200, 3)) < 0.2, np.nan, rng.random((7, 200, 3)))
    values[:, 0] = np.nan
    np.testing.assert_array_equal(nan_median(values)[0], np.full(3, np.nan))
    np.testing.assert_allclose(nan_median(values)[1:], np.nanmedian(values[:, 1:], axis=0))
