"""The darkening law, compared with the images that it describes."""

import itertools

import numpy as np
import pytest
from skimage.color import rgb2xyz, xyz2rgb
from skimage.transform import resize

from l2dgs_jax.data.color import linear_to_srgb, srgb_to_linear
from l2dgs_jax.model.tone import darkening, lit_level, recognise
from l2dgs_jax.model.tone_curves import equalising_law


def test_transfer_functions_are_inverse_and_agree_with_scikit_image():
    values = np.linspace(0, 1, 101)
    np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(values)), values, atol=1e-6)
    grey = np.tile(values[:, None], 3)
    np.testing.assert_allclose(xyz2rgb(rgb2xyz(grey)), grey, atol=1e-3)
    linear_luminance = rgb2xyz(grey)[:, 1]
    np.testing.assert_allclose(srgb_to_linear(values), linear_luminance, atol=1e-4)


@pytest.mark.parametrize("exposure", [0.03, 0.1, 0.4])
def test_the_law_describes_an_underexposed_image(exposure):
    lit = np.random.default_rng(0).beta(2, 2.3, 10_000)
    dark = linear_to_srgb(exposure * srgb_to_linear(lit))
    exponent, gain, _ = darkening(dark.mean(), lit.mean())
    law = gain * lit**exponent
    # With its exponent the law must be closer than a gain alone.
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


def test_a_gain_is_a_law_with_the_smallest_exponent():
    exponent, gain, _ = darkening(0.07, 0.46, "gain")
    assert exponent == pytest.approx(1.01)
    assert gain * 0.46**exponent == pytest.approx(0.07)


def test_in_linear_light_the_law_is_nearly_a_gain_and_invertible():
    law = darkening(0.07, 0.46, of_light=True)
    assert law.exponent == pytest.approx(1.01)
    values = np.linspace(0, 1, 11)
    light = law.gain * srgb_to_linear(values) ** law.exponent
    grey = linear_to_srgb(light)[:, None].repeat(3, -1)
    np.testing.assert_allclose(law.undone(grey)[0], values[:, None].repeat(3, -1), atol=1e-6)
    dark, lit = srgb_to_linear(np.array([0.07, 0.46]))
    assert law.gain * lit**law.exponent == pytest.approx(dark)


@pytest.mark.parametrize("exponent", [1.2, 1.9])
def test_an_exponent_is_taken_as_given(exponent):
    law = darkening(0.07, 0.46, exponent)
    assert law.exponent == exponent
    assert law.gain * 0.46**exponent == pytest.approx(0.07)


def photographs(contrast):
    """Smooth pictures with the log-contrast of ordinary ones, sRGB."""
    rng = np.random.default_rng(7)
    coarse = rng.normal(0, 1, (3, 6, 8))
    smooth = np.stack([resize(frame, (96, 128), order=3, mode="edge") for frame in coarse])
    return np.clip(0.4 * np.exp(contrast * smooth / smooth.std()), 0, 0.98)[..., None].repeat(3, -1)


def eight_bits(image):
    return (np.round(255 * np.clip(image, 0, 1)) / 255).astype(np.float16)


def test_clean_frames_of_low_contrast_are_recognised_as_darkened_by_a_gain():
    well = photographs(contrast=0.4)
    assert recognise(eight_bits(0.16 * well)) == "gain"


def test_frames_with_noise_or_contrast_are_recognised_as_linear_light():
    well, rng = photographs(contrast=0.4), np.random.default_rng(8)
    dim = linear_to_srgb(0.03 * srgb_to_linear(well))
    assert recognise(eight_bits(dim)) == "linear-light"
    noisy = 0.16 * well + rng.normal(0, 0.01, well.shape)
    assert recognise(eight_bits(noisy)) == "linear-light"


def test_recognition_uses_valid_pixels_only():
    frames = eight_bits(0.16 * photographs(contrast=0.4))
    frames[:, :, 64:] = np.random.default_rng(9).uniform(0, 1, (3, 96, 64, 3))
    valid = np.ones(frames.shape[:3], bool)
    assert recognise(frames, valid) == "linear-light"
    valid[:, :, 56:] = False
    assert recognise(frames, valid) == "gain"


def test_frames_without_valid_pixels_are_not_sampled():
    frames = np.full((40, 16, 16, 3), 0.1, np.float32)
    valid = np.zeros(frames.shape[:3], bool)
    valid[5:7] = True
    assert recognise(frames, valid) == "gain"
    assert lit_level(frames, valid, 0.1, of_light=True) == lit_level(frames, None, 0.1, of_light=True)
    np.testing.assert_allclose(equalising_law(frames, valid), equalising_law(frames, None))


def lit(frames, of_light=True, valid=None):
    return lit_level(frames, valid, frames.mean(), of_light=of_light)


@pytest.mark.parametrize("of_light", [True, False])
def test_frames_without_highlights_are_lit_to_mid_grey(of_light):
    frames = 0.2 * photographs(contrast=0.2)
    assert lit(frames, of_light) == pytest.approx(0.46)


@pytest.mark.parametrize("of_light", [True, False])
def test_what_is_brighter_than_white_has_more_light(of_light):
    law = darkening(0.12, 0.46, of_light=of_light)
    values = np.random.default_rng(1).uniform(size=(50, 3)) * np.linspace(0.02, 1, 50)[:, None]
    values[-1] = 1
    undone, light = law.undone(values)
    assert undone.max() == pytest.approx(1)
    color, dark = (srgb_to_linear(x) if of_light else x for x in (undone, values))
    np.testing.assert_allclose(law.gain * light[:, None] * color**law.exponent, dark, rtol=1e-4, atol=1e-6)
    assert (light[undone.max(-1) < 0.999] == 1).all()
    assert (light == 1).any()
    assert light[-1] == pytest.approx(1 / law.gain)


def test_the_lit_level_is_lowered_for_highlights():
    frames = linear_to_srgb(0.05 * srgb_to_linear(photographs(contrast=0.6)))
    level = lit(frames)
    assert 0.34 < level < 0.45
    undone = darkening(frames.mean(), level, of_light=True).undone(frames)[0]
    assert np.quantile(undone.max(-1), 0.95) == pytest.approx(0.9, abs=0.01)


@pytest.mark.parametrize("of_light", [True, False])
def test_frames_that_are_black_but_for_a_few_pixels_are_lit_to_mid_grey(of_light):
    frames = np.zeros((3, 96, 128, 3))
    frames[:, :4, :4] = 0.2
    assert lit(frames, of_light) == pytest.approx(0.46)


def test_the_lit_level_is_lowered_by_at_most_one_stop():
    frames = 0.1 * photographs(contrast=0.4)
    frames[:, :32, :32] = 1.0
    level = lit(frames)
    assert srgb_to_linear(np.array(level)) == pytest.approx(srgb_to_linear(np.array(0.46)) / 2, rel=1e-4)
    valid = np.ones(frames.shape[:3], bool)
    valid[:, :32, :32] = False
    assert lit_level(frames, valid, frames[valid].mean(), of_light=True) > 0.44
