"""The plane that most points of a scene lie on."""

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from l2dgs_jax.cameras.geometry import project_points
from l2dgs_jax.cameras.ground import FLOW_TOLERANCE, find_ground, ground_depths, horizontal_per_depth

LEVEL = np.eye(4)[None]  # of a camera whose upward direction is -y


def floor(rng, count=600, noise=0.005):
    """Points on the plane y = 1, below a level camera."""
    return np.stack([rng.uniform(-2, 2, count), 1 + noise * rng.normal(size=count), rng.uniform(2, 6, count)], axis=-1)


def test_the_normal_points_up_from_the_floor_among_other_points():
    rng = np.random.default_rng(0)
    clutter = rng.uniform((-2, -1, 2), (2, 1, 6), (800, 3))
    turn = Rotation.from_rotvec((0.3, 0.2, -0.3)).as_matrix()
    points = np.concatenate([floor(rng), clutter])
    for rotation in (np.eye(3), turn):
        viewmats = LEVEL.copy()
        viewmats[:, :3, :3] = rotation.T
        found = find_ground(points @ rotation.T, viewmats)
        assert_allclose(found.up, rotation @ (0, -1, 0), atol=0.02)
        assert_allclose(found.height, -1, atol=0.02)
        assert_allclose(find_ground(points @ rotation.T, viewmats).up, found.up)


def test_scale_and_place_do_not_matter():
    points = np.concatenate([floor(np.random.default_rng(0)), np.random.default_rng(1).uniform(-1, 1, (300, 3))])
    large, small = find_ground(1000 * points + 50, LEVEL), find_ground(points, LEVEL)
    assert_allclose(large.up, small.up, atol=1e-6)
    assert_allclose(large.height, 1000 * small.height + 50 * small.up.sum(), rtol=1e-6)


def test_noisier_points_show_the_ground_with_more_tolerance():
    rng = np.random.default_rng(0)
    points = np.concatenate([floor(rng, noise=0.1), rng.uniform((-2, -1, 2), (2, 1, 6), (2000, 3))])
    assert find_ground(points, LEVEL) is None
    found = find_ground(points, LEVEL, FLOW_TOLERANCE)
    assert_allclose(found.up, (0, -1, 0), atol=0.1)
    assert_allclose(found.height, -1, atol=0.4)


def test_there_is_no_ground_without_a_plane_or_across_the_cameras():
    rng = np.random.default_rng(0)
    assert find_ground(rng.normal(size=(2000, 3)), LEVEL) is None
    wall = floor(rng)[:, [0, 2, 1]]  # z = 1
    assert find_ground(wall, LEVEL) is None
    assert find_ground(np.zeros((5, 3)), LEVEL) is None
    assert find_ground(np.zeros((0, 3)), LEVEL) is None


def test_points_above_each_other_have_the_same_horizontal_distance():
    K = np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_rotvec((0.5, 0, 0)).as_matrix()  # looks down
    viewmat[:3, 3] = viewmat[:3, :3] @ (0.3, 2.0, 1.0)
    pole = np.stack([np.full(5, 0.4), np.linspace(-1, 1, 5), np.full(5, 3.0)], axis=-1)
    pixels, depth = project_points(pole, viewmat, K)
    factors = horizontal_per_depth(pixels, np.tile(viewmat, (5, 1, 1)), np.tile(K, (5, 1, 1)), np.array([0, -1.0, 0]))
    assert np.ptp(depth) > 0.5
    assert_allclose(factors * depth, 4.0)


def test_the_ground_is_seen_below_the_horizon_where_points_on_it_are():
    ground = find_ground(floor(np.random.default_rng(0), noise=0), LEVEL)
    K = np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]])
    viewmat = np.eye(4)
    viewmat[:3, 3] = (0.3, 0.2, 1.0)
    points = np.array([[0.5, 1, 3], [-1, 1, 8]])
    pixels, depth = project_points(points, viewmat, K)
    pixels = np.concatenate([pixels, [[50, 40], [50, 20]]])  # at the horizon and above it
    found = ground_depths(pixels, np.tile(viewmat, (4, 1, 1)), np.tile(K, (4, 1, 1)), ground)
    assert_allclose(found[:2], depth)
    assert found[2] > 1e6
    assert np.isinf(found[3])
