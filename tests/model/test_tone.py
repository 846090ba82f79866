"""The darkening law against the images that it describes."""

import itertools

import numpy as np
import pytest
from skimage.color import rgb2xyz, xyz2rgb

from l2dgs_jax.data.color import linear_to_srgb, srgb_to_linear
from l2dgs_jax.model.tone import darkening


def test_transfer_functions_are_inverse_and_agree_with_scikit_image():
    values = np.linspace(0, 1, 101)
    np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(values)), values, atol=1e-6)
    grey = np.tile(values[:, None], 3)
    np.testing.assert_allclose(xyz2rgb(rgb2xyz(grey)), grey, atol=1e-3)
    linear_luminance = rgb2xyz(grey)[:, 1]
    np.testing.assert_allclose(srgb_to_linear(values), linear_luminance, atol=1e-4)


@pytest.mark.parametrize("exposure", [0.03, 0.1, 0.4])
def test_it_describes_an_underexposed_image(exposure):
    lit = np.random.default_rng(0).beta(2, 2.3, 10_000)
    dark = linear_to_srgb(exposure * srgb_to_linear(lit))
    exponent, gain = darkening(dark.mean(), lit.mean())
    law = gain * lit**exponent
    # A gain alone is the law that the exponent must beat.
    gain_only = lit * (dark @ lit) / (lit @ lit)
    assert np.mean((law - dark) ** 2) < 0.6 * np.mean((gain_only - dark) ** 2)
    assert 1 < exponent < 2


def test_darker_means_a_larger_exponent_and_a_smaller_gain():
    laws = [darkening(level, 0.46) for level in (0.06, 0.1, 0.2, 0.3)]
    assert all(a.exponent > b.exponent and a.gain < b.gain for a, b in itertools.pairwise(laws))


def test_a_bright_image_is_left_almost_as_it_is():
    law = darkening(0.5, 0.46)
    assert law.exponent == pytest.approx(1.01)
    assert law.gain == pytest.approx(1.0, abs=0.02)
