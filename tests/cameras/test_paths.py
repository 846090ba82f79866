"""Camera paths through space and time."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2dgs_jax.cameras import camera_centres
from l2dgs_jax.cameras.paths import centre_of_attention, interpolate, is_path, orbit, space_time_path, spiral
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
    at_first_instant = path.time == 0
    assert 20 < at_first_instant.sum() < 30
    centres = centres_of(path)
    assert np.ptp(centres[at_first_instant], axis=0).max() > 0.01
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


def test_path_smooths_camera_shake():
    cameras = walk(frames=100, jitter=0.02)
    shake = lambda centres: np.abs(np.diff(centres, n=2, axis=0)).mean()
    assert shake(centres_of(space_time_path(cameras, 100))) < 0.2 * shake(centres_of(cameras))


def test_path_stays_near_one_view_if_consecutive_views_are_far_apart():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    rotations = Rotation.random(60, rng=rng).as_matrix()
    viewmat = np.tile(np.eye(4), (60, 1, 1))
    viewmat[:, :3, :3] = rotations
    viewmat[:, :3, 3] = -np.einsum("fij,fj->fi", rotations, 4 * directions)
    cameras = Camera(viewmat, np.tile(np.eye(3), (60, 1, 1)), np.linspace(0, 1, 60))
    assert not is_path(cameras)
    path = space_time_path(cameras, 48)
    assert is_path(path)
    centres = centres_of(path)
    nearest = np.linalg.norm(centres.mean(0) - 4 * directions, axis=-1).argmin()
    assert np.linalg.norm(centres - 4 * directions[nearest], axis=-1).max() < 1
    np.testing.assert_allclose(path.viewmat[:, :3, :3], np.tile(rotations[nearest], (48, 1, 1)), atol=1e-6)


def test_path_of_a_static_camera_is_static():
    cameras = Camera(np.tile(np.eye(4), (5, 1, 1)), np.tile(np.eye(3), (5, 1, 1)), np.linspace(0, 1, 5))
    path = space_time_path(cameras, 12)
    np.testing.assert_allclose(path.viewmat, np.tile(np.eye(4), (12, 1, 1)), atol=1e-12)


def watching(centres, target, up=(0.0, 0, 1)):
    """Cameras that look at a point, in order of time."""
    centres = np.asarray(centres, float)
    forward = (target - centres) / np.linalg.norm(target - centres, axis=-1, keepdims=True)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    viewmat = np.tile(np.eye(4), (len(centres), 1, 1))
    viewmat[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    viewmat[:, :3, 3] = -np.einsum("fij,fj->fi", viewmat[:, :3, :3], centres)
    K = np.tile(np.array([[14.0, 0, 8], [0, 14, 6], [0, 0, 1]]), (len(centres), 1, 1))
    return Camera(viewmat, K, np.linspace(0, 1, len(centres)))


def ring(angles, height=1.0):
    return np.stack([4 * np.cos(angles), 4 * np.sin(angles), np.full(len(angles), height)], -1)


TARGET = np.array([0.3, -0.2, 0.1])
AROUND = watching(ring(np.linspace(0, 6, 30)) + TARGET, TARGET)
IN_FRONT = watching(ring(np.linspace(-0.4, 0.6, 30)) + TARGET, TARGET)
TRIPOD = watching(np.tile([[4.0, 0, 1]], (12, 1)) + TARGET, TARGET)
DEPTH = float(np.hypot(4, 1))
every_rig = pytest.mark.parametrize("cameras", [AROUND, IN_FRONT, TRIPOD], ids=["around", "in front", "tripod"])


@every_rig
@pytest.mark.parametrize("path", [spiral, orbit])
def test_a_flight_keeps_its_distance_and_its_target_centred(cameras, path):
    times = np.linspace(0.2, 0.7, 25)
    flight = path(cameras, DEPTH, times)
    np.testing.assert_allclose(flight.time, times)
    np.testing.assert_allclose(np.linalg.det(flight.viewmat), 1)
    seen = flight.viewmat[:, :3, :3] @ TARGET + flight.viewmat[:, :3, 3]
    np.testing.assert_allclose(seen[:, :2], 0, atol=0.02 * DEPTH)
    assert (np.abs(seen[:, 2] - DEPTH) < 0.15 * DEPTH).all()
    assert (flight.viewmat[:, 1, 2] < -0.5).all()  # the world's up is up
    assert np.linalg.norm(np.ptp(camera_centres(flight.viewmat), axis=0)) > 0.05 * DEPTH
    np.testing.assert_allclose(flight.viewmat[0], flight.viewmat[-1], atol=1e-9)  # it ends where it began
    assert np.linalg.norm(np.diff(camera_centres(flight.viewmat), axis=0), axis=-1).max() < 0.5 * DEPTH


@pytest.mark.parametrize(("cameras", "first", "last"), [(AROUND, -np.pi, np.pi), (IN_FRONT, -0.4, 0.6)])
def test_an_orbit_covers_the_angles_of_the_views_only(cameras, first, last):
    level = camera_centres(orbit(cameras, DEPTH, np.linspace(0, 1, 101)).viewmat) - TARGET
    angles = np.arctan2(level[:, 1], level[:, 0])
    np.testing.assert_allclose([angles.min(), angles.max()], [first, last], atol=0.07)
    np.testing.assert_allclose(level[:, 2], 1, atol=0.1)


@every_rig
@pytest.mark.parametrize(
    "path", [spiral, orbit, lambda cameras, depth, times: interpolate(cameras, times)], ids=["spiral", "orbit", "inter"]
)
def test_paths_follow_rotation_shift_and_scale_of_the_world(cameras, path):
    turn, shift, scale = Rotation.from_rotvec([0.3, -1.1, 0.6]).as_matrix(), np.array([5.0, -2, 1]), 7.0
    times = np.linspace(0, 1, 9)

    def moved(viewmat):
        new = viewmat.copy()
        new[:, :3, :3] = viewmat[:, :3, :3] @ turn.T
        new[:, :3, 3] = scale * viewmat[:, :3, 3] - new[:, :3, :3] @ shift
        return new

    transformed = path(cameras._replace(viewmat=moved(cameras.viewmat)), scale * DEPTH, times)
    np.testing.assert_allclose(transformed.viewmat, moved(path(cameras, DEPTH, times).viewmat), atol=1e-8)


def test_the_centre_of_attention_is_where_the_axes_meet_or_at_the_depth_of_the_scene():
    np.testing.assert_allclose(centre_of_attention(AROUND, 0.9 * DEPTH), TARGET, atol=0.1)
    np.testing.assert_allclose(centre_of_attention(TRIPOD, DEPTH), TARGET, atol=1e-9)
    side_by_side = Camera(np.tile(np.eye(4), (5, 1, 1)), np.tile(np.eye(3), (5, 1, 1)), np.linspace(0, 1, 5))
    side_by_side.viewmat[:, 0, 3] = np.arange(5) - 2
    np.testing.assert_allclose(centre_of_attention(side_by_side, 3.0), [0, 0, 3], atol=1e-9)


def test_cameras_in_a_row_overhead_have_a_finite_orbit():
    above = watching([[0.01 * i, 0, 4] for i in range(5)], np.zeros(3), up=(0.0, 1, 0))
    path = orbit(above, 4.0, np.linspace(0, 1, 7))
    assert np.isfinite(path.viewmat).all()
    seen = path.viewmat[:, 2, 3]
    np.testing.assert_allclose(seen, 4, atol=0.5)
