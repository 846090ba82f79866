"""The best gain compared with a search, and the effect of saturation on it."""

import numpy as np
import pytest
from scipy.optimize import brute

from l2dgs_jax.metrics import best_gain


def frames(seed, brightest, count=3):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        truth = rng.uniform(0, 1, (20, 30, 3))
        yield np.clip(brightest * truth**1.3 + rng.normal(0, 0.02, truth.shape), 0, 1), truth


def error(pairs, gain):
    return np.mean([np.square(np.minimum(gain * p, 1) - t).mean() for p, t in pairs])


@pytest.mark.parametrize("brightest", [0.05, 0.4, 1.0, 2.0])
@pytest.mark.parametrize("seed", range(3))
def test_no_other_factor_leaves_a_smaller_error(seed, brightest):
    pairs = list(frames(seed, brightest))
    gain = best_gain(pairs)
    searched = brute(lambda g: error(pairs, g[0]), [(0.1, 40.0)], Ns=2000)
    assert error(pairs, gain) <= error(pairs, searched) * (1 + 1e-4)


def test_without_saturation_the_gain_is_the_least_squares_factor():
    pairs = [(0.3 * p, 0.6 * t) for p, t in frames(0, 0.5)]
    product, square = sum(np.vdot(p, t) for p, t in pairs), sum(np.vdot(p, p) for p, _ in pairs)
    np.testing.assert_allclose(best_gain(pairs), product / square, rtol=1e-9)


def test_saturated_pixels_do_not_lower_the_gain():
    truth = np.linspace(0.2, 0.6, 100)
    dark = truth / 4
    lamps = np.ones(300)
    gain = best_gain([(np.append(dark, lamps), np.append(truth, lamps))])
    np.testing.assert_allclose(gain, 4, rtol=1e-3)


@pytest.mark.parametrize("factor", [0.1, 0.01])
def test_the_gain_undoes_a_factor(factor):
    pairs = list(frames(1, 0.8))
    gain = best_gain(pairs)
    np.testing.assert_allclose(best_gain([(factor * p, t) for p, t in pairs]), gain / factor, rtol=1e-3)


def test_black_predictions_have_gain_one():
    black = np.zeros((12, 12, 3))
    assert best_gain([(black, black + 0.5)]) == 1
