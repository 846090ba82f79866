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


def rises(*shape):
    return jnp.asarray(RNG.normal(-4, 0.5, (*shape, tone_curves.RAMPS)))


def images(*shape):
    return jnp.asarray(RNG.uniform(0.01, 0.99, (*shape, 3)))


def quantile_curve(values):
    """The curve through the sorted values at the knots: the one that equalises their histogram."""
    return np.log(np.diff(np.quantile(values, tone_curves.KNOTS), prepend=0))


def test_a_power_law_as_a_curve_is_that_power_law():
    lit = jnp.broadcast_to(jnp.linspace(0, 1, 65)[None, :, None, None], (1, 65, 1, 3))
    dark = tone_curves.darkened(lit, jnp.asarray(tone_curves.power_law(LAW))[None])
    np.testing.assert_allclose(dark, LAW.gain * lit**LAW.exponent, atol=1e-3)
    np.testing.assert_allclose(dark[0, ::4], LAW.gain * lit[0, ::4] ** LAW.exponent, rtol=1e-12)  # the knots


def test_curves_are_monotone_and_start_at_black():
    lit = jnp.broadcast_to(jnp.linspace(0, 1, 100)[None, :, None, None], (3, 100, 1, 3))
    dark = np.asarray(tone_curves.darkened(lit, rises(3)))
    assert (np.diff(dark, axis=1) > 0).all()
    assert not dark[:, 0].any()


def test_every_view_has_the_shared_curve_and_its_own_adjustment():
    curves = ToneCurves(rises(), 0.1 * rises(4))
    own = tone_curves.of_frames(curves, jnp.array([2, 0]))
    offsets = np.asarray(curves.offsets)
    expected = np.asarray(curves.shared) + offsets[[2, 0]] - offsets.mean(0)
    np.testing.assert_allclose(own, expected, rtol=1e-12)
    everyone = tone_curves.of_frames(curves, jnp.arange(4))
    np.testing.assert_allclose(everyone.mean(0), curves.shared, rtol=1e-12)


def test_gradients():
    dark = images(2, 4, 5) / 5
    agree = partial(check_grads, order=1, modes=("rev",), atol=1e-6, rtol=1e-6)
    agree(jax.jit(tone_curves.darkened), (images(2, 4, 5), rises(2)), eps=1e-6)
    agree(jax.jit(lambda x: tone_curves.equalisation(x, dark, None)), (rises(2),))
    agree(jax.jit(tone_curves.bend), (rises(2),))
    agree(jax.jit(lambda x: tone_curves.of_frames(x, jnp.array([1]))), (ToneCurves(rises(), rises(3)),))


def test_equalisation_wants_the_curve_that_leaves_a_flat_histogram():
    dark = jnp.asarray(np.broadcast_to(RNG.uniform(0.05, 0.4, (1, 33, 31, 1)) ** 2, (1, 33, 31, 3)))
    wanted = jnp.asarray(quantile_curve(dark))[None]
    assert tone_curves.equalisation(wanted, dark, None) < 1e-5
    assert tone_curves.equalisation(wanted + 0.1, dark, None) == pytest.approx(0.01, rel=0.02)


def test_pixels_that_are_not_valid_ask_for_nothing():
    dark, curve = images(2, 6, 8) / 4, rises(2)
    valid = np.ones((2, 6, 8), bool)
    valid[0, :, 5:], valid[1] = False, False
    pull = jax.jit(jax.grad(tone_curves.equalisation))
    found, alone = pull(curve, dark, jnp.asarray(valid)), pull(curve[:1], dark[:1, :, :5], None)
    np.testing.assert_allclose(found[0], alone[0] / 2, rtol=1e-12)
    assert not found[1].any()


def test_only_power_laws_are_not_bent():
    assert tone_curves.bend(jnp.asarray(tone_curves.power_law(LAW))[None]) < 1e-20
    assert tone_curves.bend(rises(1)) > 1e-3


def test_the_law_to_start_from_is_found_in_the_frames():
    lit = RNG.uniform(0, 1, (5, 40, 40, 1)).repeat(3, -1)
    law = tone_curves.equalising_law((LAW.gain * lit**LAW.exponent).astype(np.float16), None)
    np.testing.assert_allclose(law, LAW, rtol=0.05)
    valid = np.ones((5, 40, 40), bool)
    valid[:, :20], lit[:, :20] = False, 0
    np.testing.assert_allclose(tone_curves.equalising_law(LAW.gain * lit**LAW.exponent, valid), LAW, rtol=0.05)


@pytest.mark.parametrize("level", [0.0, 0.2])
def test_frames_of_one_value_have_a_finite_law(level):
    law = tone_curves.equalising_law(np.full((2, 4, 4, 3), level), None)
    assert law.exponent == tone_curves.EXPONENT_RANGE[0]
    assert np.isfinite(law.gain)
    assert law.gain > 0
