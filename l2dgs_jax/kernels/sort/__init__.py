"""Stable sorts of the rasterizer's keys."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.kernels.selection import by_form, functions_by_form
from l2dgs_jax.kernels.sort import accelerator, cpu, reference

Pairs = tuple[Int[Array, " M"], Int[Array, " M"], Int[Array, " T1"]]


def argsort(values: Float[Array, " N"]) -> Int[Array, " N"]:
    """Indices that sort floats stably, positive NaN last; carries no gradients."""
    values = jax.lax.stop_gradient(values)
    if values.dtype.itemsize < 4:  # the keys of the fast forms have as many bits as the values, and at least 32
        values = values.astype(jnp.float32)
    # A loop of one step would be unrolled, but native calls need loops.
    cpu_form = cpu if values.shape[0] > 1 else accelerator
    forms = functions_by_form("argsort", reference=reference, cpu=cpu_form, accelerator=accelerator)
    return by_form(values, **forms, like=jax.ShapeDtypeStruct(values.shape, jnp.int32))


def sort_pairs(tiles: Int[Array, " M"], ranks: Int[Array, " M"], tile_count: int, rank_count: int) -> Pairs:
    """Pairs sorted by tile, then rank, and where each tile starts; carries no gradients.

    Args:
        tiles: 0 ... `tile_count`; the last number stands for dropped pairs.
        ranks: less than `rank_count`; those of each tile must be in ascending order.
        tile_count: number of tiles.
        rank_count: number of ranks.
    """
    counts = {"tile_count": tile_count, "rank_count": rank_count}
    forms = functions_by_form("sort_pairs", reference=reference, cpu=cpu, accelerator=accelerator, **counts)
    return by_form(tiles, ranks, **forms, like=(tiles, ranks, jax.ShapeDtypeStruct((tile_count + 1,), jnp.int32)))
