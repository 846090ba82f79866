"""Depths of tracks, estimated from the points around them and shared by neighbours that move alike."""

import numpy as np
from numpy.testing import assert_allclose

from l2dgs_jax.training.depths import depths_around, shared_depths
from l2dgs_jax.training.tracks import DEPTH_CELL, Tracks

HEIGHT, WIDTH, FRAMES = 24, 32, 8
K = np.array([[30.0, 0, WIDTH / 2], [0, 30.0, HEIGHT / 2], [0, 0, 1]])


def track(number, start, velocity):
    """A track through all frames, at constant velocity."""
    frames = np.arange(FRAMES)
    return Tracks(np.full(FRAMES, number), frames, start + frames[:, None] * velocity, np.ones(FRAMES, bool))


def cells(value=2.0):
    return np.full((FRAMES, HEIGHT // DEPTH_CELL, WIDTH // DEPTH_CELL), value, np.float32)


def test_depths_around_are_ordered_and_lie_within_those_of_the_points():
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-3, 3, (4000, 2)), rng.uniform(2, 6, (4000, 1))], axis=-1)
    still, moving = depths_around(points, np.eye(4), K, HEIGHT, WIDTH)
    assert still.shape[1:] == moving.shape == (HEIGHT // DEPTH_CELL, WIDTH // DEPTH_CELL)
    assert (np.diff(still, axis=0) > 0).all()
    assert (still[0] <= moving).all()
    assert (moving < still.mean(0)).all()
    assert still.min() >= 2
    assert still.max() <= 6


def test_without_points_in_view_depths_are_unknown():
    still, moving = depths_around(np.array([[0, 0, -1.0]]), np.eye(4), K, HEIGHT, WIDTH)
    assert np.isnan(still).all()
    assert np.isnan(moving).all()


def test_a_depth_on_which_all_agree_is_kept():
    tracks = [track(0, (4.5, 4.5), (1, 0.5)), track(1, (8.5, 6.5), (1, 0.5))]
    for depth in shared_depths(tracks, cells()):
        assert_allclose(depth, 2, rtol=1e-3)


def test_neighbours_share_a_depth_if_they_move_alike():
    first = track(0, (4.5, 2.5), (1, 0))
    depths = cells()
    depths[:, 1:] = 4.0  # depth of the points around the second track
    difference = {}
    for velocity in (1.0, -1.0):
        near, far = shared_depths([first, track(1, (8.5, 6.5), (velocity, 0))], depths)
        difference[velocity] = np.mean(far - near)
    assert difference[1.0] < 0.1
    assert difference[-1.0] > 1.5


def test_depth_changes_gradually_along_a_track():
    depths = cells()
    depths[4:] = 3.0
    (depth,) = shared_depths([track(0, (4.5, 4.5), (1, 0.5))], depths)
    assert (np.diff(depth) > 0).all()
    assert np.diff(depth).max() < 0.3


def test_where_no_point_is_in_view_depth_comes_from_the_rest_of_the_track():
    depths = cells()
    depths[3:5] = np.nan
    (depth,) = shared_depths([track(0, (4.5, 4.5), (1, 0.5))], depths)
    assert_allclose(depth, 2, rtol=1e-3)
