"""Stable sorts of the rasterizer's keys."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.kernels.selection import by_form, functions_by_form
from l2dgs_jax.kernels.sort import accelerator, cpu, reference

Pairs = tuple[Int[Array, " M"], Int[Array, " M"], Int[Array, " T1"]]


def argsort(values: Float[Array, " N"]) -> Int[Array, " N"]:
    """The stable order of floats, NaN with its sign bit clear last; carries no gradients."""
    values = jax.lax.stop_gradient(values)
    if values.dtype.itemsize < 4:  # the keys of the fast forms are as wide as the values, and 32 bits at least
        values = values.astype(jnp.float32)
    # A loop of one step would be unrolled, and native calls want loops.
    cpu_form = cpu if values.shape[0] > 1 else accelerator
    forms = functions_by_form("argsort", reference=reference, cpu=cpu_form, accelerator=accelerator)
    return by_form(values, **forms, like=jax.ShapeDtypeStruct(values.shape, jnp.int32))


def sort_pairs(tiles: Int[Array, " M"], ranks: Int[Array, " M"], tile_count: int, rank_count: int) -> Pairs:
    """Pairs sorted by tile, then rank, and where each tile starts; carries no gradients.

    Args:
        tiles: 0 ... `tile_count`; that last number collects the dropped pairs.
        ranks: less than `rank_count`; those of a tile come in ascending order.
        tile_count: how many tiles there are.
        rank_count: how many ranks there are.
    """
    counts = {"tile_count": tile_count, "rank_count": rank_count}
    forms = functions_by_form("sort_pairs", reference=reference, cpu=cpu, accelerator=accelerator, **counts)
    return by_form(tiles, ranks, **forms, like=(tiles, ranks, jax.ShapeDtypeStruct((tile_count + 1,), jnp.int32)))
