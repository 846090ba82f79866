"""Epipolar geometry of static points, compared with direct projection and hand-made matches."""

import numpy as np
import pytest

from l2dgs_jax.cameras.epipolar import EpipolarGeometry, epipolar_geometry, project, static_residuals
from l2dgs_jax.types import Camera

ANY_DEPTH = (1e-6, 1e6)
K = np.array([[100.0, 0, 50], [0, 110, 40], [0, 0, 1]])


def rectified(*baselines):
    """Geometry between a first view and views moved to its right, one for each baseline."""
    poses = np.tile(np.eye(4), (len(baselines) + 1, 1, 1))
    poses[1:, 0, 3] = -np.array(baselines)
    cameras = Camera(poses, np.tile(K, (len(poses), 1, 1)), np.zeros(len(poses)))
    return stacked([epipolar_geometry(cameras, 0, i + 1) for i in range(len(baselines))])


def stacked(geometries):
    return EpipolarGeometry(*map(np.stack, zip(*geometries, strict=True)))


def random_cameras(rng, count, scale=1.0):
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose in poses:
        axis = rng.normal(size=3) * 0.1
        x, y, z = axis
        skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        pose[:3, :3] = np.linalg.qr(np.eye(3) + skew)[0]
        pose[:3, :3] *= np.sign(np.diag(pose[:3, :3]))[None]
        pose[:3, 3] = rng.normal(size=3) * 0.3 * scale
    return Camera(poses, np.tile(K, (count, 1, 1)), np.zeros(count))


def pixels_and_depths(cameras, index, points):
    local = points @ cameras.viewmat[index, :3, :3].T + cameras.viewmat[index, :3, 3]
    homogeneous = local @ cameras.K[index].T
    return homogeneous[:, :2] / homogeneous[:, 2:], local[:, 2]


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e4])
def test_static_points_project_exactly_and_have_no_residual(scale):
    rng = np.random.default_rng(0)
    cameras = random_cameras(rng, 4, scale)
    points = rng.uniform((-1, -1, 3), (1, 1, 5), (20, 3)) * scale
    pixels, depths = pixels_and_depths(cameras, 0, points)
    truths = np.stack([pixels_and_depths(cameras, i, points)[0] for i in (1, 2, 3)])
    geometries = [epipolar_geometry(cameras, 0, i) for i in (1, 2, 3)]
    for geometry, truth in zip(geometries, truths, strict=True):
        np.testing.assert_allclose(project(geometry, pixels, 1 / depths), truth, atol=1e-9)
    np.testing.assert_allclose(project(stacked(geometries), pixels, 1 / depths), truths, atol=1e-9)
    residuals = static_residuals(stacked(geometries), pixels, truths, (0.1 / scale, 1 / scale))
    assert residuals.shape == (4, 3, 20)
    assert residuals.max() < 1e-8


def test_the_residual_is_the_distance_to_the_epipolar_line():
    pixels = np.array([[30.0, 20.0], [60.0, 50.0]])
    across = np.array([0.0, -2.5])
    matches = pixels + np.stack([[-7.0, -9.0], across], -1)
    residuals = static_residuals(rectified(0.2), pixels, matches[None], ANY_DEPTH)
    np.testing.assert_allclose(residuals[0, 0], np.abs(across), atol=1e-9)


def test_depths_out_of_range_add_a_residual_along_the_line():
    # A baseline of 0.2 shifts depth 1 / w by 20 w pixels to the left.
    pixels = np.array([[50.0, 40.0]])
    for shift, nearest in ((3.0, 0.0), (-26.0, -20.0)):
        residuals = static_residuals(rectified(0.2), pixels, pixels[None] + [shift, 4.0], (1e-9, 1.0))
        np.testing.assert_allclose(residuals[0, 0], np.hypot(shift - nearest, 4), atol=1e-6)


def test_motion_along_the_epipolar_line_has_a_residual_in_a_third_view():
    pixels = np.array([[50.0, 40.0]])
    static = np.array([[[40.0, 40.0]], [[30.0, 40.0]]])  # baselines of 0.2 and 0.4: depth 2 twice
    assert static_residuals(rectified(0.2, 0.4), pixels, static, ANY_DEPTH).max() < 1e-8
    moved = static + np.array([[[0.0, 0]], [[6.0, 0]]])
    residuals = static_residuals(rectified(0.2, 0.4), pixels, moved, ANY_DEPTH)[..., 0]
    # At the depth that fits one match, the other one is 6 or, at half the baseline, 3 pixels off.
    np.testing.assert_allclose(residuals[:2], [[0, 6], [3, 0]], atol=1e-6)


def test_swapping_the_views_of_a_pair_keeps_the_residual():
    first, second = np.array([[30.0, 20.0]]), np.array([[23.0, 22.5]])
    forward = static_residuals(rectified(0.2), first, second[None], ANY_DEPTH)
    backward = static_residuals(rectified(-0.2), second, first[None], ANY_DEPTH)
    np.testing.assert_allclose(forward, backward, atol=1e-9)


def test_under_pure_rotation_the_residual_is_the_distance_to_a_single_pixel():
    cameras = random_cameras(np.random.default_rng(1), 2)
    cameras.viewmat[:, :3, 3] = 0
    geometry = epipolar_geometry(cameras, 0, 1)
    pixels = np.array([[20.0, 30.0], [70.0, 10.0]])
    projected = project(geometry, pixels, np.ones(2))
    residuals = static_residuals(stacked([geometry]), pixels, projected[None] + [3.0, 4.0], ANY_DEPTH)
    np.testing.assert_allclose(residuals, 5, atol=1e-9)
