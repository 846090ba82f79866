"""All pairs of all boxes at once; those that do not touch are not removed but marked as dropped."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.kernels.tile_lists.ellipse import reaches_tile
from l2dgs_jax.kernels.tiles import TILE_SIZE, Tiling


def list_pairs(
    box: Int[Array, "G 4"], ellipse: Float[Array, "G 6"], tiling: Tiling
) -> tuple[Int[Array, " M"], Int[Array, " M"]]:
    """See the contract in `__init__`."""
    views, columns, rows, capacity = tiling
    count = box.shape[0]
    sizes = box[:, 2] * box[:, 3]
    ends = jnp.cumsum(sizes, dtype=jnp.int32)
    slot = jnp.repeat(jnp.arange(count, dtype=jnp.int32), sizes, total_repeat_length=capacity)
    pair = jnp.arange(capacity, dtype=jnp.int32)
    box, ellipse = box[slot], ellipse[slot]
    within = pair - (ends - sizes)[slot]
    column_count = jnp.maximum(box[:, 2], 1)
    column, row = box[:, 0] + within % column_count, box[:, 1] + within // column_count
    x, y = (TILE_SIZE * index.astype(ellipse.dtype) + 0.5 for index in (column, row))
    kept = (pair < ends[-1]) & reaches_tile(tuple(ellipse.T), x, y)
    first = slot // (count // views) * (columns * rows)
    return jnp.where(kept, first + row * columns + column, views * columns * rows), slot
