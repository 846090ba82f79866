"""Distances that the shaking of the camera tells."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse.linalg import lsqr

from l2dgs_jax.training.parallax import SPACINGS, parallax_terms, windows

FOCAL_LENGTH = 200.0


def uneven_times(count, seed=0):
    return np.cumsum(np.random.default_rng(seed).uniform(0.5, 1.5, count))


def seen(path, centres):
    """Rays from the centres to the points of a path, per unit of depth, and the depths."""
    depths = (path - centres)[:, 2]
    return (path - centres) / depths[:, None], depths


def straight(times, distance, velocity=(0.02, 0.01, 0.0)):
    return np.array([0.0, 0.0, distance]) + times[:, None] * velocity


def shaking(count, amount=0.05, seed=1):
    """Centres of a camera that shakes to the side and up and down."""
    return np.random.default_rng(seed).normal(size=(count, 3)) * (amount, amount, 0)


def test_windows_lie_within_one_track():
    numbers = np.repeat([4, 9, 2], [12, 3, 8])
    places, factors = windows(numbers, np.tile(np.arange(12.0), 2)[: len(numbers)] + np.arange(len(numbers)) * 0.01)
    assert len(places) == len(factors) == sum(max(n - 3 * spacing, 0) for n in (12, 3, 8) for spacing in SPACINGS)
    assert (numbers[places] == numbers[places[:, :1]]).all()
    assert set(np.unique(np.diff(places, axis=-1))) == set(SPACINGS)


def test_third_differences_of_what_changes_quadratically_vanish():
    times = uneven_times(20)
    places, factors = windows(np.zeros(20, int), times)
    for power in range(3):
        assert_allclose((factors * times[places] ** power).sum(-1), 0, atol=1e-9 * times.max() ** power)
    assert (np.abs((factors * times[places] ** 3).sum(-1)) > 0.1).all()
    assert_allclose(np.square(factors).sum(-1), 1)


def test_few_observations_have_no_windows():
    places, factors = windows(np.zeros(3, int), np.arange(3.0))
    assert places.shape == factors.shape == (0, 4)


@pytest.mark.parametrize("wrong", [0.6, 1.0, 1.6])
def test_the_distance_is_found_from_any_start(wrong):
    times, centres = uneven_times(24), shaking(24)
    rays, depths = seen(straight(times, 3.0), centres)
    found = np.full(24, np.log(3.0 * wrong))
    shaken = windows(np.zeros(24, int), times)
    for _ in range(20):
        terms, target = parallax_terms(shaken, found, centres, rays, FOCAL_LENGTH)
        found = found + lsqr(terms @ np.ones((24, 1)), target - terms @ found)[0]
    assert_allclose(np.exp(found), depths, rtol=1e-3)


def test_terms_are_the_derivative_of_the_error():
    times, centres = uneven_times(16), shaking(16, 1e-4)  # so small an error that all windows have the same weight
    rays, depths = seen(straight(times, 2.0, (0.01, 0.0, 0.005)), centres)
    shaken, found, step = windows(np.zeros(16, int), times), np.log(1.2 * depths), 1e-5
    error = lambda at: np.subtract(*(part(at) for part in (lambda x: terms_at(x)[0] @ x, lambda x: terms_at(x)[1])))
    terms_at = lambda at: parallax_terms(shaken, at, centres, rays, FOCAL_LENGTH)
    slope = (error(found + step) - error(found - step)) / (2 * step)
    assert_allclose(terms_at(found)[0].sum(1), slope, rtol=1e-6, atol=1e-8)


def test_a_camera_that_moves_evenly_tells_nothing():
    times = uneven_times(16)
    centres = times[:, None] * (0.03, -0.01, 0.02) + np.square(times)[:, None] * (0.001, 0.0, 0.0)
    rays, depths = seen(straight(times, 2.0), centres)
    shaken = windows(np.zeros(16, int), times)
    terms, _ = parallax_terms(shaken, np.log(depths), centres, rays, FOCAL_LENGTH)
    assert_allclose(terms.toarray(), 0, atol=1e-8)


def test_shaking_along_the_line_of_sight_tells_nothing():
    times = np.arange(16.0)
    centres = shaking(16)[:, [2, 2, 0]]
    rays, depths = seen(straight(times, 2.0, (0, 0, 0)), centres)
    terms, target = parallax_terms(windows(np.zeros(16, int), times), np.log(depths), centres, rays, FOCAL_LENGTH)
    assert_allclose(terms.toarray(), 0, atol=1e-8)
    assert_allclose(target, 0, atol=1e-8)
