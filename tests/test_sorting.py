import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2dgs_jax.rasterizer import sorting


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), ties=st.booleans())
def test_argsort_is_numpys_stable_one(dtype, seed, ties):
    values = np.random.default_rng(seed).normal(size=300).astype(dtype)
    values[:4] = np.inf, -np.inf, np.nan, 0
    values = np.round(values, 1) + 0.0 if ties else values  # no -0.0, which numpy takes for a 0.0
    np.testing.assert_array_equal(_argsort(jnp.asarray(values)), np.argsort(values, kind="stable"))


_argsort = jax.jit(sorting.argsort)


def test_argsort_in_a_batch_and_of_hardly_anything():
    values = jnp.asarray(np.random.default_rng(0).normal(size=(3, 50)))
    np.testing.assert_array_equal(jax.vmap(sorting.argsort)(values), np.argsort(values, axis=-1))
    for size in range(3):
        np.testing.assert_array_equal(sorting.argsort(-jnp.arange(float(size))), np.arange(size)[::-1])


@pytest.mark.parametrize("tile_count", [1, 7, 1000])
def test_every_way_to_group_agrees(tile_count):
    random = np.random.default_rng(tile_count)
    tiles, ranks = random.integers(0, tile_count + 1, 400).astype(np.int32), np.arange(400, dtype=np.int32)
    order = np.lexsort((ranks, tiles))
    expected = tiles[order], ranks[order], np.searchsorted(tiles[order], range(tile_count + 1))
    one_key, two_keys = 400, 2**31
    for result in (
        jax.jit(lambda t, r: sorting.group(t, r, tile_count, one_key))(tiles, ranks),
        sorting._by_comparing(jnp.asarray(tiles), jnp.asarray(ranks), tile_count, one_key),
        sorting._by_comparing(jnp.asarray(tiles), jnp.asarray(ranks), tile_count, two_keys),
    ):
        for actual, wanted in zip(result, expected, strict=True):
            np.testing.assert_array_equal(actual, wanted)
