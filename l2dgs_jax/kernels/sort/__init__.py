"""Stable sorts of the rasterizer's keys."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.kernels.selection import by_form
from l2dgs_jax.kernels.sort import accelerator, cpu, reference

Pairs = tuple[Int[Array, " M"], Int[Array, " M"], Int[Array, " T1"]]


def argsort(values: Float[Array, " N"]) -> Int[Array, " N"]:
    """The stable order of floats, NaN with its sign bit clear last; carries no gradients."""
    values = jax.lax.stop_gradient(values)
    return by_form(
        values,
        reference=reference.argsort,
        cpu=cpu.argsort if values.shape[0] > 1 else reference.argsort,  # loops of one step would be unrolled
        accelerator=accelerator.argsort,
        like=jax.ShapeDtypeStruct(values.shape, jnp.int32),
    )


def sort_pairs(tiles: Int[Array, " M"], ranks: Int[Array, " M"], tile_count: int, rank_count: int) -> Pairs:
    """Pairs sorted by tile, then rank, and where each tile starts; carries no gradients.

    Args:
        tiles: 0 ... `tile_count`; that last number collects the dropped pairs.
        ranks: less than `rank_count`; those of a tile come in ascending order.
        tile_count: how many tiles there are.
        rank_count: how many ranks there are.
    """
    counts = {"tile_count": tile_count, "rank_count": rank_count}
    return by_form(
        tiles,
        ranks,
        reference=lambda tiles, ranks: reference.sort_pairs(tiles, ranks, **counts),
        cpu=lambda tiles, ranks: cpu.sort_pairs(tiles, ranks, **counts),
        accelerator=lambda tiles, ranks: accelerator.sort_pairs(tiles, ranks, **counts),
        like=(tiles, ranks, jax.ShapeDtypeStruct((tile_count + 1,), jnp.int32)),
    )
