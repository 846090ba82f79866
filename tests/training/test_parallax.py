"""Distances that the shaking of the camera tells."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from l2dgs_jax.training.parallax import (
    MAX_STEP,
    MAX_WEIGHT,
    SPACINGS,
    WEIGHT,
    estimates,
    find_windows,
    third_difference,
)

FOCAL_LENGTH = 200.0


def uneven_times(count, seed=0):
    return np.cumsum(np.random.default_rng(seed).uniform(0.5, 1.5, count))


def seen(path, centres):
    """Rays from the centres to the points of a path, per unit of depth, and the depths."""
    depths = (path - centres)[:, 2]
    return (path - centres) / depths[:, None], depths


def straight(times, distance, velocity=(0.02, 0.01, 0.0)):
    return np.array([0.0, 0.0, distance]) + times[:, None] * velocity


def shaken_centres(count, amount=0.05, seed=1):
    """Centres of a camera that shakes to the side and up and down."""
    return np.random.default_rng(seed).normal(size=(count, 3)) * (amount, amount, 0)


def one_track(count=24, amount=0.05, distance=3.0):
    """Times, centres, rays and log-distances of a track that moves straight on, seen by a shaking camera."""
    times, centres = uneven_times(count), shaken_centres(count, amount)
    rays, depths = seen(straight(times, distance), centres)
    return times, centres, rays, np.log(depths)


def windows_of(times, centres, rays):
    """The windows of one track."""
    return find_windows(np.zeros(len(times), int), times, centres, rays)


def test_windows_lie_within_one_track():
    numbers = np.repeat([4, 9, 2], [12, 3, 8])
    found = find_windows(numbers, np.arange(23.0), np.zeros((23, 3)), np.ones((23, 3)))
    places = found.places
    assert len(places) == len(found.rays) == sum(max(n - 3 * spacing, 0) for n in (12, 3, 8) for spacing in SPACINGS)
    assert (numbers[places] == numbers[places[:, :1]]).all()
    assert set(np.unique(np.diff(places, axis=-1))) == set(SPACINGS)


def test_third_differences_of_what_changes_quadratically_vanish():
    times = uneven_times(20)
    places = windows_of(times, np.zeros((20, 3)), np.ones((20, 3))).places
    factors = third_difference(times[places])
    for power in range(3):
        assert_allclose((factors * times[places] ** power).sum(-1), 0, atol=1e-9 * times.max() ** power)
    assert (np.abs((factors * times[places] ** 3).sum(-1)) > 0.1).all()
    assert_allclose(np.square(factors).sum(-1), 1)


@pytest.mark.parametrize("count", [0, 1, 3, 6])
def test_few_observations_have_no_windows(count):
    found = windows_of(np.arange(float(count)), np.zeros((count, 3)), np.ones((count, 3)))
    assert found.places.shape == (0, 4)
    assert found.rays.shape == (0, 4, 3)


@pytest.mark.parametrize("wrong", [0.1, 0.6, 1.0, 1.6, 10.0])
@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_every_window_finds_the_distance_from_any_start(wrong, scale):
    times, centres, rays, true = one_track()
    windows = windows_of(times, centres, scale * rays)
    found = true + np.log(wrong / scale)
    means = lambda distances: distances[windows.places].mean(-1)
    for _ in range(30):
        estimate, _ = estimates(windows, found, FOCAL_LENGTH)
        assert (np.abs(estimate - means(found)) <= MAX_STEP + 1e-9).all()
        found = found + (estimate - means(found)).mean()
    assert_allclose(estimate, means(true) - np.log(scale), atol=0.02)


def test_the_weight_is_that_of_the_visible_shaking():
    weights = {}
    for amount in (0.001, 0.002):
        *track, true = one_track(amount=amount)
        _, weights[amount] = estimates(windows_of(*track), true, FOCAL_LENGTH)
    assert_allclose(weights[0.002], 4 * weights[0.001], rtol=0.05)
    *track, true = one_track(amount=0.5)
    assert estimates(windows_of(*track), true, FOCAL_LENGTH)[1].max() == MAX_WEIGHT


def test_observations_that_jump_count_little():
    times, centres, rays, true = one_track(amount=0.002)
    jumped = rays.copy()
    jumped[12] += (20 / FOCAL_LENGTH, 0, 0)
    windows = [windows_of(times, centres, x) for x in (rays, jumped)]
    touched = (windows[0].places == 12).any(-1)
    (_, before), (_, after) = (estimates(x, true, FOCAL_LENGTH) for x in windows)
    assert_allclose(after[~touched], before[~touched])
    assert (after[touched] < 0.2 * before[touched]).all()
    assert (before > 0).all()
    assert WEIGHT < 1


def test_a_camera_that_moves_evenly_tells_nothing():
    times = uneven_times(16)
    centres = times[:, None] * (0.03, -0.01, 0.02) + np.square(times)[:, None] * (0.001, 0.0, 0.0)
    rays, depths = seen(straight(times, 2.0), centres)
    _, weights = estimates(windows_of(times, centres, rays), np.log(depths), FOCAL_LENGTH)
    assert_allclose(weights, 0, atol=1e-8)


def test_shaking_along_the_line_of_sight_tells_nothing():
    times, centres = np.arange(16.0), shaken_centres(16)[:, [2, 2, 0]]
    rays, depths = seen(straight(times, 2.0, (0, 0, 0)), centres)
    estimate, weights = estimates(windows_of(times, centres, rays), np.log(depths), FOCAL_LENGTH)
    assert np.isfinite(estimate).all()
    assert_allclose(weights, 0, atol=1e-8)
