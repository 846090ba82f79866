from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.model import tone_curves
from l2dgs_jax.model.tone import Darkening
from l2dgs_jax.types import ToneCurves

RNG = np.random.default_rng(0)
LAW = Darkening(1.4, 0.4)


def random_curves(*shape):
    return jnp.asarray(RNG.normal(-4, 0.5, (*shape, tone_curves.RAMPS)))


def images(*shape):
    return jnp.asarray(RNG.uniform(0.01, 0.99, (*shape, 3)))


def quantile_curve(values):
    """The curve through the quantiles of the values, which equalises their histogram."""
    return np.log(np.diff(np.quantile(values, tone_curves.KNOTS), prepend=0))


def test_the_curve_of_a_power_law_reproduces_it():
    lit = jnp.broadcast_to(jnp.linspace(0, 1, 65)[None, :, None, None], (1, 65, 1, 3))
    dark = tone_curves.darkened(lit, jnp.asarray(tone_curves.power_law(LAW))[None])
    np.testing.assert_allclose(dark, LAW.gain * lit**LAW.exponent, atol=1e-3)
    np.testing.assert_allclose(dark[0, ::4], LAW.gain * lit[0, ::4] ** LAW.exponent, rtol=1e-12)  # exact at the knots


def test_curves_are_monotone_and_start_at_black():
    lit = jnp.broadcast_to(jnp.linspace(0, 1, 100)[None, :, None, None], (3, 100, 1, 3))
    dark = np.asarray(tone_curves.darkened(lit, random_curves(3)))
    assert (np.diff(dark, axis=1) > 0).all()
    assert not dark[:, 0].any()


def test_every_view_has_the_shared_curve_and_its_own_adjustment():
    curves = ToneCurves(random_curves(), 0.1 * random_curves(4))
    own = tone_curves.of_frames(curves, jnp.array([2, 0]))
    offsets = np.asarray(curves.offsets)
    expected = np.asarray(curves.shared) + offsets[[2, 0]] - offsets.mean(0)
    np.testing.assert_allclose(own, expected, rtol=1e-12)
    all_frames = tone_curves.of_frames(curves, jnp.arange(4))
    np.testing.assert_allclose(all_frames.mean(0), curves.shared, rtol=1e-12)


def test_gradients():
    dark = images(2, 4, 5) / 5
    check = partial(check_grads, order=1, modes=("rev",), atol=1e-6, rtol=1e-6)
    check(jax.jit(tone_curves.darkened), (images(2, 4, 5), random_curves(2)), eps=1e-6)
    check(jax.jit(lambda x: tone_curves.equalisation(x, dark, None)), (random_curves(2),))
    check(jax.jit(tone_curves.bend), (random_curves(2),))
    check(jax.jit(lambda x: tone_curves.of_frames(x, jnp.array([1]))), (ToneCurves(random_curves(), random_curves(3)),))


def test_equalisation_is_least_for_the_curve_that_flattens_the_histogram():
    dark = jnp.asarray(np.broadcast_to(RNG.uniform(0.05, 0.4, (1, 33, 31, 1)) ** 2, (1, 33, 31, 3)))
    flattening = jnp.asarray(quantile_curve(dark))[None]
    assert tone_curves.equalisation(flattening, dark, None) < 1e-5
    assert tone_curves.equalisation(flattening + 0.1, dark, None) == pytest.approx(0.01, rel=0.02)


def test_invalid_pixels_do_not_affect_the_equalisation():
    dark, curve = images(2, 6, 8) / 4, random_curves(2)
    valid = np.ones((2, 6, 8), bool)
    valid[0, :, 5:], valid[1] = False, False
    gradient = jax.jit(jax.grad(tone_curves.equalisation))
    found, alone = gradient(curve, dark, jnp.asarray(valid)), gradient(curve[:1], dark[:1, :, :5], None)
    np.testing.assert_allclose(found[0], alone[0] / 2, rtol=1e-12)
    assert not found[1].any()


def test_bend_is_zero_for_power_laws_only():
    assert tone_curves.bend(jnp.asarray(tone_curves.power_law(LAW))[None]) < 1e-20
    assert tone_curves.bend(random_curves(1)) > 1e-3


def test_the_equalising_law_is_recovered_from_the_frames():
    lit = RNG.uniform(0, 1, (5, 40, 40, 1)).repeat(3, -1)
    law = tone_curves.equalising_law((LAW.gain * lit**LAW.exponent).astype(np.float16), None)
    np.testing.assert_allclose(law, LAW, rtol=0.05)
    valid = np.ones((5, 40, 40), bool)
    valid[:, :20], lit[:, :20] = False, 0
    np.testing.assert_allclose(tone_curves.equalising_law(LAW.gain * lit**LAW.exponent, valid), LAW, rtol=0.05)


def test_the_equalising_law_of_more_pixels_than_a_float_counts_is_finite():
    frames = np.broadcast_to(np.float16(0.1), (1, 2**12, 2**12 + 4, 3))
    with jax.enable_x64(False):
        law = tone_curves.equalising_law(frames, None)
    assert np.isfinite(law).all()


@pytest.mark.parametrize("level", [0.0, 0.2])
def test_frames_of_one_value_have_a_finite_law(level):
    law = tone_curves.equalising_law(np.full((2, 4, 4, 3), level), None)
    assert law.exponent == tone_curves.EXPONENT_RANGE[0]
    assert np.isfinite(law.gain)
    assert law.gain > 0
