"""The sorts written with jax.numpy."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def argsort(values: Float[Array, " N"]) -> Int[Array, " N"]:
    """See the contract in `__init__`."""
    return jnp.argsort(values, stable=True).astype(jnp.int32)


def sort_pairs(
    tiles: Int[Array, " M"], ranks: Int[Array, " M"], *, tile_count: int, rank_count: int
) -> tuple[Int[Array, " M"], Int[Array, " M"], Int[Array, " T1"]]:
    """See the contract in `__init__`."""
    del rank_count
    order = jnp.lexsort((ranks, tiles))
    starts = jnp.searchsorted(tiles[order], jnp.arange(tile_count + 1, dtype=tiles.dtype))
    return tiles[order], ranks[order], starts.astype(jnp.int32)
