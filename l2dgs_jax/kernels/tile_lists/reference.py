"""Every Gaussian tested against every tile of its view at once; memory grows with their product."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.kernels.tile_lists.ellipse import reaches_tile
from l2dgs_jax.kernels.tiles import TILE_SIZE, Tiling


def list_pairs(
    box: Int[Array, "G 4"], ellipse: Float[Array, "G 6"], tiling: Tiling
) -> tuple[Int[Array, " M"], Int[Array, " M"]]:
    """See the contract in `__init__`."""
    tiles = tiling.columns * tiling.rows
    count = len(box) // tiling.views
    left, top, width, height = (entry[:, None] for entry in box.T)
    column, row = (index[None] for index in jnp.divmod(jnp.arange(tiles, dtype=jnp.int32), tiling.columns)[::-1])
    inside = (left <= column) & (column < left + width) & (top <= row) & (row < top + height)
    x, y = (jnp.broadcast_to(TILE_SIZE * index.astype(ellipse.dtype) + 0.5, inside.shape) for index in (column, row))
    entries = tuple(jnp.broadcast_to(entry[:, None], inside.shape) for entry in ellipse.T)
    touched = inside & reaches_tile(entries, x, y)
    slot, tile = jnp.nonzero(touched, size=tiling.capacity, fill_value=(0, -1))
    first = slot // count * tiles
    return jnp.where(tile < 0, tiling.views * tiles, first + tile).astype(jnp.int32), slot.astype(jnp.int32)
