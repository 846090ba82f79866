"""Sorts of integer keys, for which vendors' libraries are fastest."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.kernels.sort.keys import ordered_integers


def argsort(values: Float[Array, " N"]) -> Int[Array, " N"]:
    """See the contract in `__init__`."""
    index = jnp.arange(values.shape[0], dtype=jnp.int32)
    return jax.lax.sort((ordered_integers(values), index), num_keys=1, is_stable=True)[1]


def sort_pairs(
    tiles: Int[Array, " M"], ranks: Int[Array, " M"], *, tile_count: int, rank_count: int
) -> tuple[Int[Array, " M"], Int[Array, " M"], Int[Array, " T1"]]:
    """See the contract in `__init__`."""
    bits = rank_count.bit_length()
    # Starts come from counts, because a binary search is a chain of dependent steps. Dropped pairs, which are many, are
    # not counted: all of their additions would wait for one address.
    sizes = jnp.zeros(tile_count, jnp.int32).at[tiles].add(1, mode="drop")
    starts = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(sizes, dtype=jnp.int32)])
    if bits + tile_count.bit_length() > 32:
        tiles, ranks = jax.lax.sort((tiles, ranks), num_keys=2)
        return tiles, ranks, starts
    # One key of 32 bits sorts several times faster than a key with a payload.
    keys = jnp.sort((tiles.astype(jnp.uint32) << bits) | ranks.astype(jnp.uint32))
    return (keys >> bits).astype(jnp.int32), (keys & (2**bits - 1)).astype(jnp.int32), starts
