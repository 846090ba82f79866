"""Paths through space and time."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2dgs_jax.cameras.paths import space_time_path
from l2dgs_jax.types import Camera


def walk(frames=40, jitter=0.0, seed=0):
    """A camera that walks along x while it turns, with noise."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, frames)
    centres = np.stack([2 * time, 0.1 * np.sin(3 * time), 0.2 * time], -1) + jitter * rng.normal(size=(frames, 3))
    rotations = Rotation.from_rotvec(np.outer(0.5 * time, [0, 1, 0])).as_matrix()
    viewmat = np.tile(np.eye(4), (frames, 1, 1))
    viewmat[:, :3, :3] = rotations
    viewmat[:, :3, 3] = -np.einsum("fij,fj->fi", rotations, centres)
    K = np.tile(np.array([[14.0, 0, 8], [0, 14, 6], [0, 0, 1]]), (frames, 1, 1))
    return Camera(*(x.astype(np.float32) for x in (viewmat, K, time)))


def centres_of(cameras):
    return -np.einsum("fji,fj->fi", cameras.viewmat[:, :3, :3], cameras.viewmat[:, :3, 3])


@pytest.mark.parametrize("frames", [1, 2, 5, 96])
def test_path_has_valid_cameras_and_time_runs_once(frames):
    cameras = walk(jitter=0.02)
    path = space_time_path(cameras, frames)
    rotations = path.viewmat[:, :3, :3]
    assert all(x.dtype == np.float32 for x in path)
    assert path.viewmat.shape == (frames, 4, 4)
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (frames, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-5)
    np.testing.assert_array_equal(path.viewmat[:, 3], np.tile([0, 0, 0, 1], (frames, 1)))
    np.testing.assert_allclose(path.K, np.tile(cameras.K[0], (frames, 1, 1)), rtol=1e-6)
    assert (np.diff(path.time) >= 0).all()
    assert path.time[0] == 0
    if frames > 1:
        assert path.time[-1] == 1


def test_path_first_moves_through_space_alone_then_follows_the_trained_views():
    cameras = walk()
    path = space_time_path(cameras, 96)
    still = path.time == 0
    assert 20 < still.sum() < 30
    centres = centres_of(path)
    assert np.ptp(centres[still], axis=0).max() > 0.01
    trained = centres_of(cameras)
    size = np.ptp(trained, axis=0).max()
    nearest = np.linalg.norm(centres[:, None] - trained[None], axis=-1).min(1)
    assert nearest.max() < 0.1 * size
    assert np.ptp(centres[:, 0]) > 0.8 * size


def test_path_does_not_depend_on_the_order_of_the_views():
    cameras = walk(jitter=0.05)
    order = np.random.default_rng(1).permutation(len(cameras.time))
    shuffled = space_time_path(Camera(*(x[order] for x in cameras)), 24)
    for a, b in zip(space_time_path(cameras, 24), shuffled, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_path_smooths_the_shake_of_the_hand():
    cameras = walk(frames=100, jitter=0.02)
    shake = lambda centres: np.abs(np.diff(centres, n=2, axis=0)).mean()
    assert shake(centres_of(space_time_path(cameras, 100))) < 0.2 * shake(centres_of(cameras))


def test_path_stays_near_one_view_where_the_views_jump_about():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    rotations = Rotation.random(60, rng=rng).as_matrix()
    viewmat = np.tile(np.eye(4), (60, 1, 1))
    viewmat[:, :3, :3] = rotations
    viewmat[:, :3, 3] = -np.einsum("fij,fj->fi", rotations, 4 * directions)
    cameras = Camera(viewmat, np.tile(np.eye(3), (60, 1, 1)), np.linspace(0, 1, 60))
    path = space_time_path(cameras, 48)
    centres = centres_of(path)
    nearest = np.linalg.norm(centres.mean(0) - 4 * directions, axis=-1).argmin()
    assert np.linalg.norm(centres - 4 * directions[nearest], axis=-1).max() < 1
    np.testing.assert_allclose(path.viewmat[:, :3, :3], np.tile(rotations[nearest], (48, 1, 1)), atol=1e-6)


def test_path_of_a_camera_that_stands_still():
    cameras = Camera(np.tile(np.eye(4), (5, 1, 1)), np.tile(np.eye(3), (5, 1, 1)), np.linspace(0, 1, 5))
    path = space_time_path(cameras, 12)
    np.testing.assert_allclose(path.viewmat, np.tile(np.eye(4), (12, 1, 1)), atol=1e-12)
