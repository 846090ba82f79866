from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.data.color import linear_to_srgb, srgb_to_linear
from l2dgs_jax.model.decomposition import clip_unit, decompose, power
from l2dgs_jax.model.networks import apply_bafe
from l2dgs_jax.types import BAFENet, Conv, GroupNorm

CFG = ModelConfig()
decompose_jit = jax.jit(partial(decompose, cfg=CFG))


def make_bafe(dtype=jnp.float64):
    rng = np.random.default_rng(0)

    def conv(size, inputs, outputs):
        weight = rng.normal(0, (size * size * inputs) ** -0.5, (size, size, inputs, outputs))
        return Conv(jnp.asarray(weight, dtype), jnp.asarray(rng.normal(0, 0.1, outputs), dtype))

    def norm(channels):
        return GroupNorm(jnp.ones(channels, dtype), jnp.zeros(channels, dtype))

    return BAFENet(conv(5, 2, 8), norm(8), conv(3, 8, 16), norm(16), conv(3, 16, 8), norm(8), conv(1, 8, 2))


def make_features(*shape, low=0.1, high=0.9, dtype=jnp.float64):
    return jnp.asarray(np.random.default_rng(1).uniform(low, high, (*shape, 6)), dtype)


@jax.jit
def gradients(features, bafe):
    """Gradients of the sum of all images."""

    def objective(features, bafe):
        return sum(image.sum() for image in decompose(features, bafe, CFG))

    return jax.grad(objective, (0, 1))(features, bafe)


def all_finite(tree):
    return all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def test_images_follow_eqs_5_to_9():
    features, bafe = make_features(2, 4, 5, low=-0.5, high=1.5), make_bafe()
    images = jax.tree.map(np.asarray, decompose_jit(features, bafe))
    exponents = np.asarray(apply_bafe(bafe, features[..., 4:]))
    for index in np.ndindex(2, 4, 5):
        illumination = min(max(float(features[index][0]), 0.0), 1.0)
        np.testing.assert_allclose(images.illumination[index], illumination, rtol=1e-12)
        np.testing.assert_allclose(images.attenuation[index], exponents[index], rtol=1e-9)
        b1, b2 = exponents[index]
        for channel in range(3):
            reflectance = min(max(float(features[index][1 + channel]), 0.0), 1.0)
            pixel = (*index, channel)
            np.testing.assert_allclose(images.reflectance[pixel], reflectance, rtol=1e-12)
            np.testing.assert_allclose(images.welllit[pixel], illumination * reflectance, rtol=1e-12)
            np.testing.assert_allclose(images.lowlight[pixel], illumination**b2 * reflectance**b1, rtol=1e-9)


LIGHT = ModelConfig(domain="light", relative_light=True, initial_illumination=0.7)


def test_in_the_light_domain_eqs_7_and_9_apply_to_linear_light():
    features = make_features(2, 4, 5, low=0.05, high=1.5)
    images = jax.tree.map(np.asarray, decompose(features, make_bafe(), LIGHT))
    light, color = images.illumination[..., None], srgb_to_linear(images.reflectance)
    b1, b2 = images.attenuation[..., :1], images.attenuation[..., 1:]
    bright = light / 0.7 * color
    np.testing.assert_allclose(images.welllit, linear_to_srgb(np.minimum(bright, 1)), rtol=1e-9)
    np.testing.assert_allclose(images.lowlight, linear_to_srgb(light**b2 * color**b1), rtol=1e-9)
    assert (bright > 1).any()


def test_at_the_initial_illumination_the_well_lit_image_is_the_reflectance():
    features = make_features(2, 4, 5).at[..., 0].set(0.7)
    images = decompose(features, make_bafe(), LIGHT)
    np.testing.assert_allclose(images.welllit, images.reflectance, rtol=1e-9)


def test_gradients_of_the_images_in_the_light_domain():
    # Dim light, as values clipped at 1 have no gradient.
    features, bafe = make_features(2, 4, 5).at[..., 0].multiply(0.7), make_bafe()
    check_grads(jax.jit(partial(decompose, cfg=LIGHT)), (features, bafe), 1, ("rev",), 1e-5, 1e-5, eps=1e-6)
    black = jnp.zeros((1, 4, 5, 6))
    assert all_finite(jax.grad(lambda x: sum(i.sum() for i in decompose(x, bafe, LIGHT)))(black))


def test_the_low_light_image_is_never_brighter():
    images = decompose_jit(make_features(2, 4, 5, low=-0.5, high=1.5), make_bafe())
    assert (images.lowlight <= images.welllit).all()
    assert (images.attenuation > 1).all()
    assert (images.attenuation < 10).all()


def test_gradients_of_the_images():
    features, bafe = make_features(2, 4, 5), make_bafe()
    check_grads(decompose_jit, (features, bafe), 1, ("rev",), 1e-5, 1e-5, eps=1e-6)


def test_gradients_of_power():
    base = jnp.asarray(np.random.default_rng(2).uniform(0.05, 1, (3, 4)))
    exponent = 1 + 9 * jnp.asarray(np.random.default_rng(3).uniform(size=(3, 4)))
    check_grads(jax.jit(power), (base, exponent), 1, ("fwd", "rev"), 1e-5, 1e-5, eps=1e-6)
    check_grads(jax.jit(power), (base, exponent[:, :1]), 1, ("fwd", "rev"), 1e-5, 1e-5, eps=1e-6)
    check_grads(jax.jit(power), (base, exponent[0, 0]), 1, ("fwd", "rev"), 1e-5, 1e-5, eps=1e-6)


power_gradients = jax.jit(jax.grad(lambda base, exponent: power(base, exponent).sum(), (0, 1)))


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_power_near_zero(dtype):
    smallest = float(jnp.finfo(dtype).smallest_subnormal)
    base = jnp.asarray([0.0, smallest, 0.5 * float(jnp.finfo(dtype).tiny), float(jnp.finfo(dtype).tiny), 1e-30], dtype)
    for exponent in (1.0, 1.5, 10.0):
        exponents = jnp.full_like(base, exponent)
        values = power(base, exponents)
        slopes = power_gradients(base, exponents)
        np.testing.assert_allclose(values, np.asarray(base) ** exponent, atol=1e-12)
        assert all_finite(slopes)
        assert slopes[1][0] == 0
        assert slopes[0][0] == 0


def test_clipping_has_gradients_on_its_bounds_but_none_outside():
    x = jnp.asarray([-1e30, -1e-9, 0.0, 0.5, 1.0, 1 + 1e-9, 1e30])
    np.testing.assert_array_equal(clip_unit(x), [0, 0, 0, 0.5, 1, 1, 1])
    np.testing.assert_array_equal(jax.vmap(jax.grad(clip_unit))(x), [0, 0, 1, 1, 1, 0, 0])


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("level", [0.0, 1.0, -3.0, 3.0, 1e-38, 1e30, -1e30])
def test_flat_features_stay_finite(level, dtype):
    features, bafe = jnp.full((2, 4, 5, 6), level, dtype), make_bafe(dtype)
    for image in decompose_jit(features, bafe):
        assert image.dtype == dtype
        assert jnp.isfinite(image).all()
    assert all_finite(gradients(features, bafe))


@pytest.mark.parametrize("channels", [slice(0, 1), slice(1, 4)], ids=["black L", "black R"])
def test_one_black_factor_blackens_both_images(channels):
    features = make_features(2, 4, 5).at[..., channels].set(0.0)
    images = decompose_jit(features, make_bafe())
    assert not images.welllit.any()
    assert not images.lowlight.any()
    assert all_finite(gradients(features, make_bafe()))


def test_a_single_pixel_is_finite():
    features = make_features(1, 1, 1)
    assert all_finite(decompose_jit(features, make_bafe()))
    assert all_finite(gradients(features, make_bafe()))


def test_batches_are_independent_views():
    features, bafe = make_features(2, 4, 5), make_bafe()
    together = decompose_jit(features, bafe)
    for index in range(2):
        alone = decompose_jit(features[index], bafe)
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[index], b, rtol=1e-9)


def test_without_a_decomposition_both_images_are_the_blended_colour():
    features = make_features(2, 4, 5, low=-0.5, high=1.5)
    images = decompose(features, make_bafe(), ModelConfig(decomposition="none"))
    for image in (images.welllit, images.lowlight):
        np.testing.assert_array_equal(image, np.clip(features[..., 1:4], 0, 1))
    assert (images.illumination == 1).all()
    assert (images.attenuation == 1).all()


@pytest.mark.parametrize(("name", "index"), [("b1", 0), ("b2", 1)])
def test_an_exponent_of_1_leaves_its_factor_as_it_is(name, index):
    features, bafe = make_features(2, 4, 5), make_bafe()
    usual, images = decompose_jit(features, bafe), decompose(features, bafe, ModelConfig(unit_exponent=name))
    kept, changed = images.attenuation[..., 1 - index], images.attenuation[..., index]
    np.testing.assert_allclose(kept, usual.attenuation[..., 1 - index], rtol=1e-12)
    assert (changed == 1).all()
    light, color = images.illumination[..., None], images.reflectance
    expected = color * light ** kept[..., None] if name == "b1" else light * color ** kept[..., None]
    np.testing.assert_allclose(images.lowlight, expected, rtol=1e-9)


def test_without_bafe_net_exponents_depend_on_their_pixel_only():
    """They rise with the pixel's own b1 and b2, and stay in BAFE-Net's range."""
    features, bafe, cfg = make_features(1, 4, 5, low=-9, high=9), make_bafe(), ModelConfig(bafe=False)
    exponents = decompose(features, bafe, cfg).attenuation
    assert ((exponents > 1) & (exponents < 10)).all()
    order = np.argsort(features[..., 4].ravel())
    assert (np.diff(exponents[..., 0].ravel()[order]) > 0).all()
    alone = decompose(features[:, 1:2, 2:3], bafe, cfg).attenuation
    np.testing.assert_array_equal(alone, exponents[:, 1:2, 2:3])
