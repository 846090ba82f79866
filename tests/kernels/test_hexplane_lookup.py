"""Lookups in planes and lines: every form, its gradients and batches compared with the reference."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.kernels import use_kernels
from l2dgs_jax.kernels.hexplane_lookup import Layout, lookup

SIZES, VIEWS, CHANNELS, POINTS = (3, 5), 2, 4, 6


def case(points=POINTS, seed=0):
    random = np.random.default_rng(seed)
    rows = sum(3 * size * size for size in SIZES), sum(3 * VIEWS * size for size in SIZES)
    space, lines = (jnp.asarray(random.normal(size=(n, CHANNELS))) for n in rows)
    size = np.tile(SIZES, points)
    cell = tuple(jnp.asarray(random.integers(0, size - 1), jnp.int32) for _ in range(3))
    weight = tuple(jnp.asarray(random.uniform(size=len(size))) for _ in range(3))
    return space, lines, cell, weight


@functools.cache
def with_gradients(layout):
    def run(space, lines, cell, weight, cotangent):
        found, pull = jax.vjp(
            lambda space, lines, weight: lookup(space, lines, cell, weight, layout), space, lines, weight
        )
        return found, pull(cotangent)

    return jax.jit(run)


def assert_close(actual, expected):
    jax.tree.map(lambda a, e: np.testing.assert_allclose(a, e, rtol=1e-12, atol=1e-13), actual, expected)


@pytest.mark.parametrize(
    ("aggregation", "points"), [("paired_sum", POINTS), ("product", POINTS), ("product", 1), ("product", 0)]
)
def test_every_form_matches_the_reference(any_way, aggregation, points):
    layout = Layout(SIZES, VIEWS, aggregation)
    arrays = case(points)
    cotangent = jnp.asarray(np.random.default_rng(1).normal(size=(VIEWS, 2 * points, CHANNELS)))
    with use_kernels("reference"):
        expected = with_gradients(layout)(*arrays, cotangent)
    assert expected[0].shape == cotangent.shape
    assert_close(with_gradients(layout)(*arrays, cotangent), expected)


@pytest.mark.parametrize("aggregation", ["paired_sum", "product"])
def test_gradients_of_the_reference(aggregation):
    space, lines, cell, weight = case(2)
    function = lambda space, lines, weight: lookup(space, lines, cell, weight, Layout(SIZES, VIEWS, aggregation))
    with use_kernels("reference"):
        check_grads(jax.jit(function), (space, lines, weight), order=1, modes=["rev"], eps=1e-5)


def test_vmap_equals_a_loop(any_form):
    layout = Layout(SIZES, VIEWS, "paired_sum")
    cases = [case(seed=seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *cases)
    cotangent = jnp.ones((VIEWS, 2 * POINTS, CHANNELS))
    together = jax.jit(jax.vmap(with_gradients(layout), (0, 0, 0, 0, None)))(*stacked, cotangent)
    with use_kernels("reference"):
        alone = [with_gradients(layout)(*arrays, cotangent) for arrays in cases]
    assert_close(together, jax.tree.map(lambda *x: jnp.stack(x), *alone))


def test_a_nan_shows_where_it_is_read(any_form):
    space, lines, cell, weight = case()
    found = lookup(space, lines, cell, (weight[0].at[3].set(jnp.nan), *weight[1:]), Layout(SIZES, VIEWS, "paired_sum"))
    assert np.isnan(found[:, 3]).all()
    assert np.isfinite(np.delete(found, 3, axis=1)).all()
