"""Blocks of tiles whose lists are walked together."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int
from numpy.typing import DTypeLike

from l2dgs_jax.kernels.tiles import TILE_SIZE, TileLists, grid


class Block(NamedTuple):
    """Tiles whose lists are walked together: where their lists start and stop, and the middle of each tile."""

    starts: Int[Array, "*S B"]
    stops: Int[Array, "*S B"]
    centres: Float[Array, "*S B 2"]


def tile_centres(tiles: Int[Array, "*S"], width: int, height: int, dtype: DTypeLike) -> Float[Array, "*S 2"]:
    """The middle of each tile, pixels."""
    columns, rows = grid(width, height)
    corners = TILE_SIZE * jnp.stack([tiles % columns, tiles // columns % rows], axis=-1)
    return corners.astype(jnp.dtype(dtype)) + TILE_SIZE / 2


def in_blocks(
    lists: TileLists, size: int, width: int, height: int, dtype: DTypeLike
) -> tuple[Block, Int[Array, "S B"], Int[Array, " T"]]:
    """The tiles in blocks of one size, sorted by the lengths of their lists, so that those of a block are similar.

    Returns:
        The blocks; the tile of each of their entries (the last block is filled up with empty lists of the first tile);
        and the entry of each tile.
    """
    count = lists.starts.shape[0]
    size = min(size, count)
    order = jnp.argsort(lists.starts - lists.stops).astype(jnp.int32)
    tiles = jnp.pad(order, (0, -count % size)).reshape(-1, size)
    filler = jnp.arange(tiles.size).reshape(tiles.shape) >= count
    starts = lists.starts[tiles]
    stops = jnp.where(filler, starts, lists.stops[tiles])
    position = jnp.zeros_like(order).at[order].set(jnp.arange(count, dtype=jnp.int32))
    return Block(starts, stops, tile_centres(tiles, width, height, dtype)), tiles, position
