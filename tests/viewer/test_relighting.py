"""Relighting by sliders."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.data.color import linear_to_srgb, srgb_to_linear
from l2dgs_jax.types import Decomposition
from l2dgs_jax.viewer.relighting import LUMINANCE, Light, relit, white_balance

RANDOM = np.random.default_rng(0)
SETTINGS = st.floats(-1, 1)


@pytest.fixture(scope="module")
def images():
    light, colour = RANDOM.uniform(0.02, 0.9, (6, 8)), RANDOM.uniform(0.02, 0.9, (6, 8, 3))
    exponents = RANDOM.uniform(1.05, 9.5, (6, 8, 2))
    dark = light[..., None] ** exponents[..., 1:] * colour ** exponents[..., :1]
    return jax.tree.map(jnp.asarray, Decomposition(light[..., None] * colour, dark, light, colour, exponents))


def relighted(images: Decomposition, cfg: ModelConfig = ModelConfig(), **light: float) -> np.ndarray:  # noqa: B008
    return np.asarray(relit(images, Light(**light), cfg))


def test_both_images_are_reproduced_in_the_light_domain(images):
    cfg = ModelConfig(domain="light", relative_light=True, initial_illumination=0.95)
    light, colour, exponents = images.illumination[..., None], srgb_to_linear(images.reflectance), images.attenuation
    welllit = linear_to_srgb(light / 0.95 * colour)
    lowlight = linear_to_srgb(light ** exponents[..., 1:] * colour ** exponents[..., :1])
    np.testing.assert_allclose(relighted(images, cfg), welllit, atol=2e-4)
    np.testing.assert_allclose(relighted(images, cfg, brightness=0.0), lowlight, atol=2e-4)


def test_by_default_the_picture_is_the_well_lit_image(images):
    np.testing.assert_allclose(relighted(images), images.welllit, atol=2e-4)


def test_with_brightness_zero_the_picture_is_the_low_light_image(images):
    np.testing.assert_allclose(relighted(images, brightness=0.0), images.lowlight, atol=2e-4)


def test_brightness_brightens_every_pixel(images):
    steps = [relighted(images, brightness=float(b)) for b in np.linspace(0, 2, 9)]
    assert all((after > before).all() for before, after in itertools.pairwise(steps))


def test_without_shading_only_reflectance_is_left(images):
    np.testing.assert_allclose(relighted(images, shading=0.0), images.reflectance, atol=2e-4)


def test_a_stop_is_twice_the_light(images):
    before, after = (srgb_to_linear(relighted(images, gain=gain)) for gain in (-2.0, -1.0))
    np.testing.assert_allclose(after, 2 * before, rtol=1e-5)


@settings(deadline=None)
@given(SETTINGS, SETTINGS)
def test_the_white_balance_keeps_the_luminance_of_grey(warmth, tint):
    gains = np.asarray(white_balance(warmth, tint))
    assert LUMINANCE @ gains == pytest.approx(1)
    assert (gains[0] - gains[2]) * warmth >= 0
    assert (gains[0] * gains[2] - gains[1] ** 2) * tint >= -1e-12


def test_black_stays_black_and_white_does_not_overflow(images):
    black = images._replace(reflectance=jnp.zeros_like(images.reflectance))
    assert not relighted(black, brightness=2.0, gain=3.0).any()
    assert relighted(images, gain=3.0).max() <= 1
