import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2dgs_jax.kernels import use_kernels
from l2dgs_jax.kernels.sort import argsort, sort_pairs

_argsort = jax.jit(argsort)


@pytest.mark.parametrize("form", ["reference", "cpu", "accelerator"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), ties=st.booleans())
def test_argsort_equals_numpys_stable_argsort(form, dtype, seed, ties):
    values = np.random.default_rng(seed).normal(size=300).astype(dtype)
    values[:4] = np.inf, -np.inf, np.nan, 0
    values = np.round(values, 1) + 0.0 if ties else values  # no -0.0, which numpy considers equal to 0.0
    with use_kernels(form):
        np.testing.assert_array_equal(_argsort(jnp.asarray(values)), np.argsort(values, kind="stable"))


def test_argsort_of_batches_and_of_up_to_two_values(any_form):
    values = jnp.asarray(np.random.default_rng(0).normal(size=(3, 50)))
    np.testing.assert_array_equal(jax.jit(jax.vmap(argsort))(values), np.argsort(values, axis=-1))
    for size in range(3):
        np.testing.assert_array_equal(argsort(-jnp.arange(float(size))), np.arange(size)[::-1])


@pytest.mark.parametrize("rank_count", [400, 2**31], ids=["one key", "two keys"])
@pytest.mark.parametrize("tile_count", [1, 7, 1000])
def test_pairs_are_sorted_by_tile_and_rank(any_way, tile_count, rank_count):
    random = np.random.default_rng(tile_count)
    tiles, ranks = random.integers(0, tile_count + 1, 400).astype(np.int32), np.arange(400, dtype=np.int32)
    order = np.lexsort((ranks, tiles))
    expected = tiles[order], ranks[order], np.searchsorted(tiles[order], range(tile_count + 1))
    result = jax.jit(lambda t, r: sort_pairs(t, r, tile_count, rank_count))(tiles, ranks)
    for actual, wanted in zip(result, expected, strict=True):
        assert actual.dtype == jnp.int32
        np.testing.assert_array_equal(actual, wanted)


def test_batches_of_pairs_equal_a_loop(any_form):
    tiles = jnp.asarray(np.random.default_rng(0).integers(0, 9, (3, 60)), jnp.int32)
    ranks = jnp.tile(jnp.arange(60, dtype=jnp.int32), (3, 1))
    sort = lambda t, r: sort_pairs(t, r, 8, 60)
    together = jax.jit(jax.vmap(sort))(tiles, ranks)
    for index in range(3):
        for actual, wanted in zip(together, sort(tiles[index], ranks[index]), strict=True):
            np.testing.assert_array_equal(actual[index], wanted)
