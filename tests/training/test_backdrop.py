"""What lies behind moving things, from the points around and from the ground's plane."""

import numpy as np
from numpy.testing import assert_allclose

from l2dgs_jax.cameras.geometry import project_points
from l2dgs_jax.cameras.ground import Ground
from l2dgs_jax.training.backdrop import (
    CANDIDATES,
    DEPTH_CELL,
    Backdrop,
    Cameras,
    Depths,
    depths_around,
    find_backdrop,
    floor_depths,
    hidden_depths,
    unprojected,
)
from l2dgs_jax.types import Camera

HEIGHT, WIDTH = 24, 32
K = np.array([[30.0, 0, WIDTH / 2], [0, 30.0, HEIGHT / 2], [0, 0, 1]])


def test_depths_around_are_ordered_and_lie_within_those_of_the_points():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-3, 3, (4000, 2)), rng.uniform(2, 6, (4000, 1))], axis=-1)
    still, hidden = depths_around(points, np.eye(4), K, HEIGHT, WIDTH)
    assert still.shape[1:] == hidden.shape == (HEIGHT // DEPTH_CELL, WIDTH // DEPTH_CELL)
    assert (np.diff(still, axis=0) > 0).all()
    assert (still[0] < hidden).all()
    assert (hidden < still[-1]).all()
    assert still.min() >= 2
    assert still.max() <= 6


def test_without_points_in_view_depths_are_unknown():
    still, hidden = depths_around(np.array([[0, 0, -1.0]]), np.eye(4), K, HEIGHT, WIDTH)
    assert np.isnan(still).all()
    assert np.isnan(hidden).all()


def seen(hidden, ground=None):
    """The backdrop of a frame whose cells all have one depth."""
    cells = np.full((1, HEIGHT // DEPTH_CELL, WIDTH // DEPTH_CELL), hidden, np.float32)
    cameras = Cameras(np.eye(4)[None], K[None], np.zeros(1))
    return Backdrop(cameras, Depths(np.tile(cells, (CANDIDATES, 1, 1, 1)), cells), ground)


LOW = Ground(np.array([0, -1.0, 0]), -0.5)  # half a unit below the camera, which looks at the horizon
PIXELS = np.array([[5.5, 18.0], [20.5, 18.5]])
DISTANCES = 0.5 * 30 / (PIXELS[:, 1] - HEIGHT / 2)  # of the ground there
FRAMES = np.zeros(2, int)


def test_a_surface_that_is_nearly_as_far_away_as_the_ground_is_the_ground():
    for depths in (floor_depths, hidden_depths):
        assert_allclose(depths(seen(2.2, LOW), FRAMES, PIXELS), DISTANCES)


def test_things_do_not_stand_on_a_surface_that_is_not_the_ground():
    assert np.isnan(floor_depths(seen(1.0, LOW), FRAMES, PIXELS)).all()
    assert_allclose(hidden_depths(seen(1.0, LOW), FRAMES, PIXELS), 1)


def test_there_is_no_ground_above_the_horizon():
    above = PIXELS - np.array([0.0, 12.0])
    assert np.isnan(floor_depths(seen(2.2, LOW), FRAMES, above)).all()
    assert_allclose(hidden_depths(seen(2.2, LOW), FRAMES, above), 2.2, rtol=1e-6)


def test_where_no_ground_is_known_things_may_stand_on_any_surface():
    assert_allclose(floor_depths(seen(1.7), FRAMES, PIXELS), 1.7, rtol=1e-6)
    assert_allclose(hidden_depths(seen(1.7), FRAMES, PIXELS), 1.7, rtol=1e-6)


def test_the_backdrop_of_frames_has_their_depths_and_the_ground():
    rng = np.random.default_rng(0)
    floor = np.stack([rng.uniform(-3, 3, 3000), np.full(3000, 0.5), rng.uniform(1, 6, 3000)], axis=-1)
    camera = Camera(np.tile(np.eye(4, dtype=np.float32), (2, 1, 1)), np.tile(K, (2, 1, 1)), np.zeros(2))
    backdrop = find_backdrop(floor, camera, HEIGHT, WIDTH)
    assert backdrop.depths.still.shape == (CANDIDATES, 2, *backdrop.depths.hidden.shape[1:])
    assert_allclose(backdrop.ground.up, [0, -1, 0], atol=1e-6)
    assert_allclose(floor_depths(backdrop, np.array([0, 1]), PIXELS), DISTANCES, rtol=1e-3)


def test_unprojected_points_project_back():
    cameras = seen(1.0).cameras
    pixels, depth = project_points(unprojected(cameras, FRAMES, PIXELS, np.array([2.0, 3.0])), np.eye(4), K)
    assert_allclose(pixels, PIXELS)
    assert_allclose(depth, [2, 3])
