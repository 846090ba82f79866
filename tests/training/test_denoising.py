"""Frames averaged with their neighbours, compared with what they would be without noise."""

import dataclasses

import numpy as np
import pytest
from tiny_training import make_dataset, tiny

from l2dgs_jax.data import Split
from l2dgs_jax.training import engine, initial_state
from l2dgs_jax.training.denoising import denoised
from l2dgs_jax.training.flows import Flows, concatenated
from l2dgs_jax.types import Camera

HEIGHT, WIDTH, FRAMES, SPEED, NOISE = 40, 60, 7, 2, 0.01  # pixels a frame; standard deviation
INNER = slice(12, -12), slice(12, -12)
NEW = slice(14, 22), slice(20, 28)  # where frame 3 shows what no other frame does


def pictures():
    """A texture that moves to the right."""
    texture = np.random.default_rng(0).uniform(0.1, 0.3, (HEIGHT, WIDTH + SPEED * FRAMES, 3))
    return np.stack([texture[:, SPEED * (FRAMES - i) :][:, :WIDTH] for i in range(FRAMES)])


@pytest.fixture(scope="module")
def truth():
    frames = pictures()
    frames[3][NEW] = 0.8
    return frames


@pytest.fixture(scope="module")
def split(truth):
    cameras = Camera(np.tile(np.eye(4), (FRAMES, 1, 1)), np.tile(np.eye(3), (FRAMES, 1, 1)), np.linspace(0, 1, FRAMES))
    noisy = truth + np.random.default_rng(1).normal(0, NOISE, truth.shape)
    return Split(tuple(map(str, range(FRAMES))), cameras, noisy.astype(np.float32))


@pytest.fixture(scope="module")
def flows():
    """True displacements."""
    displacements = np.zeros((FRAMES, 2, HEIGHT, WIDTH, 2), np.float16)
    displacements[:, 0, ..., 0], displacements[:, 1, ..., 0] = SPEED, -SPEED
    return Flows(np.minimum(np.arange(FRAMES) + 1, FRAMES - 1), displacements)


def error(split, truth, frame):
    return np.sqrt(np.square(split.images[frame] - truth[frame])[INNER].mean())


def test_noise_falls_by_the_number_of_frames_that_show_the_same(split, flows, truth):
    quiet = denoised(split, flows)
    for frame, shown in ((0, 3), (6, 3)):
        assert error(quiet, truth, frame) == pytest.approx(NOISE / np.sqrt(shown), rel=0.15)
    moved = np.abs(quiet.images[[0, 6]] - truth[[0, 6]])[:, *INNER].mean((0, 1, 2))
    assert np.all(moved < NOISE / 2)


def test_what_one_frame_alone_shows_stays_in_it_and_in_no_other(split, flows, truth):
    quiet = denoised(split, flows)
    assert quiet.images[3][NEW].mean() == pytest.approx(0.8, abs=0.01)
    for frame in (1, 2, 4, 5):
        assert np.abs(quiet.images[frame] - truth[frame])[INNER].max() < 0.06


def test_without_flow_frames_stay_as_they_are(split, flows):
    unknown = flows._replace(displacements=np.full_like(flows.displacements, np.nan))
    np.testing.assert_array_equal(denoised(split, unknown).images, split.images)
    alone = flows._replace(following=np.arange(FRAMES))
    np.testing.assert_array_equal(denoised(split, alone).images, split.images)


def test_invalid_pixels_of_neighbours_do_not_count(split, flows, truth):
    valid = np.ones((FRAMES, HEIGHT, WIDTH), bool)
    valid[1:] = False
    split = dataclasses.replace(split, valid=valid)
    np.testing.assert_array_equal(denoised(split, flows).images[0], split.images[0])


def test_flows_add_up_where_both_are_known():
    first, second = np.zeros((2, 6, 8, 2), np.float32)
    first[..., 0], second[..., 1] = 2, -1
    second[3, 5] = np.nan
    both = concatenated(first, second)
    known = np.isfinite(both[..., 0])
    np.testing.assert_array_equal(both[known], [[2, -1]] * known.sum())
    assert not known[:, -2:].any()  # it leads out of the image
    assert not known[3, 3]
    assert known[:2, :6].all()
    assert known[5, :6].all()


@pytest.mark.parametrize("denoise", [False, True])
def test_training_sees_the_frames_with_less_noise(monkeypatch, denoise):
    seen = {}
    monkeypatch.setattr(engine, "denoised", lambda split, flows: dataclasses.replace(split, images=0.5 * split.images))
    monkeypatch.setattr(engine, "next_batch", lambda split, config, step, flows: seen.update(split=split) or stop())
    dataset, config = make_dataset(), tiny(denoise=denoise)

    def stop():
        raise InterruptedError

    with pytest.raises(InterruptedError):
        next(engine.run([engine.Member(dataset.train, config, initial_state(dataset, config))]))
    np.testing.assert_allclose(seen["split"].images, (0.5 if denoise else 1) * dataset.train.images, rtol=1e-3)
