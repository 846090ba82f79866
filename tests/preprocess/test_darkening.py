"""The low-light pipeline: what each step does to single values, and what holds for every picture."""

import numpy as np
import pytest
from skimage.color import rgb2lab

from l2dgs_jax.data.color import srgb_to_linear
from l2dgs_jax.preprocess.lowlight import darkening


def picture(seed=0, low=0.0, high=1.0):
    return np.random.default_rng(seed).uniform(low, high, (20, 24, 3)).astype(np.float32)


def constant(value):
    """A darkener that returns the same lightness everywhere."""
    return lambda light, _: np.full_like(light, value)


def test_lightness_is_that_of_cie():
    image = picture()
    np.testing.assert_allclose(darkening.lightness(image), rgb2lab(image)[..., 0] / 100, atol=2e-3)
    red = np.zeros((1, 1, 3), np.float32)
    red[..., 0] = 1
    np.testing.assert_allclose(darkening.lightness(red), 0.5324, atol=1e-3)
    np.testing.assert_allclose(darkening.lightness(red, "lednet"), 0.3230, atol=1e-3)  # that of blue


def test_saturated_pixels_keep_their_exposure():
    light = np.array([0, 0.5, 0.97, 0.975, 1], np.float32)
    np.testing.assert_array_equal(darkening.exposure_map(light, 0.1), np.float32([0.1, 0.1, 0.1, 0.975, 1]))


def test_the_ratio_of_lightness_scales_every_channel():
    image = picture(low=0.2)
    expected = image * (0.1 / darkening.lightness(image))[..., None]
    np.testing.assert_allclose(darkening.darken(image, 0.1, constant(0.1), "correct"), expected, rtol=1e-5)
    swapped = image * (0.1 / darkening.lightness(image[..., ::-1].copy()))[..., None]
    np.testing.assert_allclose(darkening.darken(image, 0.1, constant(0.1), "lednet"), swapped, rtol=1e-5)


def test_the_darkener_is_given_lightness_and_exposure_map():
    image = picture()
    image[0, 0] = 1
    calls = []
    darkening.darken(image, 0.2, lambda *planes: calls.append(planes) or planes[0], "correct")
    ((light, exposure),) = calls
    np.testing.assert_array_equal(light, darkening.lightness(image))
    assert exposure[0, 0] == light[0, 0] == 1
    assert exposure[1, 1] == np.float32(0.2)


def test_nothing_is_brightened_unless_allowed():
    image = picture()
    image[:5] = 0
    np.testing.assert_array_equal(darkening.darken(image, 0.2, constant(0.9), "correct") <= image, True)
    brightened = darkening.darken(image, 0.2, constant(0.9), "correct", brighten=True)
    assert (brightened > image).mean() > 0.3
    assert brightened.max() <= 1
    np.testing.assert_array_equal(brightened[:5], 0)


def test_truncation_keeps_whole_levels_and_drops_the_rest():
    levels = np.arange(256, dtype=np.uint8).reshape(1, 256, 1).repeat(3, -1)
    np.testing.assert_array_equal(darkening.truncate(levels.astype(np.float32) / 255), levels)
    np.testing.assert_array_equal(darkening.truncate((levels[:, :-1] + np.float32(0.99)) / 255), levels[:, :-1])


@pytest.mark.parametrize("exposure", [0.03, 0.1, 0.3])
def test_analytic_curve_is_a_scale_that_keeps_highlights_and_order(exposure):
    light = np.random.default_rng(0).uniform(0, 0.7, 5000).astype(np.float32)
    clipped = np.concatenate([light, np.ones(2000, np.float32)])
    darkener = darkening.analytic_darkener(clipped, exposure)
    dark = darkener(light[None], light[None])
    np.testing.assert_allclose(dark.mean(), exposure, rtol=1e-3)
    np.testing.assert_allclose((dark[0] / light)[light < 0.6], exposure / light.mean(), rtol=1e-3)
    ramp = np.linspace(0, 1, 1001, dtype=np.float32)[None]
    ordered = darkener(ramp, ramp)
    assert np.all(np.diff(ordered) > 0)
    assert np.all(ordered <= ramp)
    assert ordered[0, -1] == 1


@pytest.mark.parametrize("level", [0.2, 0.0, 1.0])
def test_analytic_curve_leaves_dark_and_saturated_images_unchanged(level):
    light = np.full((3, 4), level, np.float32)
    np.testing.assert_array_equal(darkening.analytic_darkener(light.ravel(), 0.3)(light, light), light)


def test_sensor_noise_has_the_moments_of_photons_and_read_out():
    level, photons, read_noise = 0.5, 500.0, 10.0
    image = np.full((150, 150, 3), level, np.float32)
    noisy = darkening.add_sensor_noise(image, (0, 1), photons, read_noise)
    linear = ((noisy + 0.055) / 1.055) ** 2.4
    expected = ((level + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(linear.mean(), expected, rtol=0.005)
    np.testing.assert_allclose(photons**2 * linear.var(), photons * expected + read_noise**2, rtol=0.05)
    np.testing.assert_array_equal(noisy, darkening.add_sensor_noise(image, (0, 1), photons, read_noise))
    assert (noisy != darkening.add_sensor_noise(image, (0, 2), photons, read_noise)).any()
    black = darkening.add_sensor_noise(np.zeros((50, 50, 3), np.float32), (0,), photons, read_noise)
    assert black.min() == 0
    assert black.max() > 0


def test_less_light_brings_pixels_to_the_exposure_and_keeps_the_ratios_of_their_channels():
    pixels = picture(high=0.9).reshape(-1, 1, 3)
    dark = darkening.scale_light(pixels, darkening.light_factor(pixels, 0.1))
    np.testing.assert_allclose(darkening.lightness(dark).mean(), 0.1, atol=1e-4)
    linear, bright = srgb_to_linear(dark), srgb_to_linear(pixels)
    np.testing.assert_allclose(linear / linear.sum(), bright / bright.sum(), atol=1e-6)


def test_less_light_leaves_dark_and_saturated_pixels_unchanged():
    assert darkening.light_factor(picture(high=0.05).reshape(-1, 1, 3), 0.1) == 1
    assert darkening.light_factor(np.ones((5, 1, 3), np.float32), 0.1) == 1


def test_no_pixels_have_no_lightness():
    assert darkening.lightness(np.zeros((0, 1, 3), np.float32)).shape == (0, 1)
    assert darkening.light_factor(np.zeros((0, 1, 3), np.float32), 0.1) == 1
