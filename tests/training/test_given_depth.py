import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from scipy.optimize import minimize

from l2dgs_jax.training import given_depth
from l2dgs_jax.training.given_depth import HUBER_DELTA, depth_disagreement, in_world_units

V, H, W = 2, 6, 8
disagreement = jax.jit(depth_disagreement)


def views(seed=0, noise=0.2):
    """Rendered depth and alpha, and given depth that differs by more than scale and shift, with gaps in both."""
    rng = np.random.default_rng(seed)
    alpha = rng.uniform(0.6, 1, (V, H, W))
    distance = rng.uniform(1, 4, (V, H, W))
    inverse = 0.3 + 2 / distance * (1 + noise * rng.normal(size=distance.shape))
    alpha[0, 0, :3] = 0.2
    inverse[:, 2, 3:5] = 0
    given = np.divide(1, inverse, out=np.zeros_like(inverse), where=inverse > 0)
    return jnp.asarray(alpha * distance), jnp.asarray(alpha), jnp.asarray(given)


def expected(depth, alpha, given):
    """The least mean over lines (scale and shift of inverse depth), found by another solver."""
    total = 0.0
    for d, a, g in zip(*map(np.asarray, (depth, alpha, given)), strict=True):
        known = (g > 0) & (a > 0.5)
        y, x = a[known] / d[known], 1 / g[known]
        y, x = y / y.mean(), x / x.mean()

        def cost(line, x=x, y=y):
            return HUBER_DELTA * (np.sqrt(1 + ((y - abs(line[0]) * x - line[1]) / HUBER_DELTA) ** 2) - 1).sum()

        total += minimize(cost, (1, 0), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12}).fun
    return total / np.size(depth)


@pytest.mark.parametrize("seed", range(3))
def test_disagreement_is_the_least_mean_difference_over_scales_and_shifts(seed):
    arrays = views(seed)
    np.testing.assert_allclose(disagreement(*arrays), expected(*arrays), rtol=1e-4)


@settings(deadline=None, max_examples=30)
@given(scale=st.floats(0.01, 100), shift=st.floats(0, 3), unit=st.floats(0.01, 100))
def test_disagreement_ignores_scale_shift_and_unit(scale, shift, unit):
    depth, alpha, target = views()
    other = jnp.where(target > 0, 1 / (scale * (1 / jnp.where(target > 0, target, 1) + shift)), 0)
    np.testing.assert_allclose(disagreement(unit * depth, alpha, other), disagreement(depth, alpha, target), rtol=1e-6)


def test_equal_distances_cost_nothing_whatever_the_opacity():
    depth, alpha, _ = views()
    distance = depth / alpha
    np.testing.assert_allclose(disagreement(depth, alpha, distance), 0, atol=1e-12)
    fainter = 0.8 * alpha.at[0, 0, :3].set(1)
    np.testing.assert_allclose(disagreement(fainter * distance, fainter, distance), 0, atol=1e-12)
    assert disagreement(depth, alpha, 5 - distance) > 0.1  # near and far swapped


def test_gradients(monkeypatch):
    """Gradients are those of the exact minimum; few iterations of the fit come within 5 % of them."""
    depth, alpha, target = views()
    few_iterations = jax.grad(depth_disagreement, (0, 1))(depth, alpha, target)
    monkeypatch.setattr(given_depth, "FIT_ITERATIONS", 1000)
    function = jax.jit(lambda depth, alpha: depth_disagreement(depth, alpha, target))
    check_grads(function, (depth, alpha), order=1, modes=("rev",), eps=1e-6, atol=1e-7, rtol=1e-5)
    for x, y in zip(few_iterations, jax.grad(function, (0, 1))(depth, alpha), strict=True):
        assert np.linalg.norm(x - y) < 0.05 * np.linalg.norm(y)


@pytest.mark.parametrize("level", [0.0, 1e-6, 1.0])
@pytest.mark.parametrize("told", ["nothing", "one pixel", "the same everywhere", "extremes"])
def test_uninformative_depth_gives_finite_values_in_single_precision(level, told):
    given = {
        "nothing": np.zeros((V, H, W)),
        "one pixel": np.eye(H, W)[None].repeat(V, 0) * (np.arange(H) == 2)[:, None],
        "the same everywhere": np.full((V, H, W), 3.0),
        "extremes": np.where(np.arange(W) % 2, 1e-18, 1e18) * np.ones((V, H, 1)),
    }[told]
    depth, alpha = np.full((V, H, W), level), np.full((V, H, W), level > 0)
    depth, alpha, given = (jnp.asarray(x, jnp.float32) for x in (depth, alpha, given))
    value, slopes = jax.jit(jax.value_and_grad(depth_disagreement, (0, 1)))(depth, alpha, given)
    assert value.dtype == jnp.float32
    assert all(jnp.isfinite(x).all() for x in (value, *slopes))
    assert value < 1e-6


def test_disagreement_is_the_mean_over_views():
    arrays = views()
    each = [disagreement(*(x[v : v + 1] for x in arrays)) for v in range(V)]
    np.testing.assert_allclose(disagreement(*arrays), np.mean(each), rtol=1e-9)


K = np.array([[40.0, 0, 16], [0, 40.0, 12], [0, 0, 1]])


def slope(count=300, hidden=0):
    """Depth of a slope in a frame of 32x24, and points on it, some of them moved far behind it."""
    depth = np.broadcast_to(np.linspace(2, 5, 24)[:, None], (24, 32)).astype(np.float32)
    rng = np.random.default_rng(0)
    rows, columns = rng.integers(24, size=count), rng.integers(32, size=count)
    distances = np.where(np.arange(count) < hidden, rng.uniform(1.3, 3, count), 1) * depth[rows, columns]
    points = distances[:, None] * (np.stack([columns + 0.5, rows + 0.5, np.ones(count)], axis=-1) @ np.linalg.inv(K).T)
    return depth, points


@pytest.mark.parametrize("hidden", [0, 100])
def test_given_depth_gets_the_unit_of_the_points(hidden):
    depth, points = slope(hidden=hidden)
    given = (1 / (3 / depth + 0.5)).astype(np.float32)
    np.testing.assert_allclose(in_world_units(given, points, np.eye(4), K), depth, rtol=1e-2)


def test_unknown_depth_stays_unknown():
    depth, points = slope()
    given = np.where(np.arange(32) < 10, 0, depth).astype(np.float32)
    found = in_world_units(given, points, np.eye(4), K)
    assert np.isnan(found[:, :10]).all()
    np.testing.assert_allclose(found[:, 10:], depth[:, 10:], rtol=1e-5)


@pytest.mark.parametrize("why", ["few points", "no points in view", "contradiction", "flat"])
def test_depth_that_points_do_not_bear_out_is_unknown(why):
    depth, points = slope(count=9 if why == "few points" else 300)
    if why == "no points in view":
        points = points - [0, 0, 100]
    elif why == "contradiction":
        depth = depth[::-1].copy()
    elif why == "flat":
        depth = np.full_like(depth, 3)
    found = in_world_units(depth, points, np.eye(4), K)
    assert np.isnan(found).all()
