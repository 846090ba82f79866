"""A loop over the Gaussians and the tiles of their boxes; pairs that touch are stored one after the other."""

from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.kernels.compilation import native_call
from l2dgs_jax.kernels.loops import Index, loop, read, write
from l2dgs_jax.kernels.tile_lists.ellipse import reaches_tile
from l2dgs_jax.kernels.tiles import TILE_SIZE, Tiling

Listed = tuple[Index, Int[Array, " M1"], Int[Array, " M1"]]  # number of pairs so far, their tiles, their Gaussians


def list_pairs(
    box: Int[Array, "G 4"], ellipse: Float[Array, "G 6"], tiling: Tiling
) -> tuple[Int[Array, " M"], Int[Array, " M"]]:
    """See the contract in `__init__`; at least two Gaussians."""
    views, columns, rows, capacity = tiling
    count = box.shape[0] // views
    nowhere = views * columns * rows

    def listed(
        box: tuple[Int[Array, " G"], ...], ellipse: tuple[Float[Array, " G"], ...]
    ) -> tuple[Int[Array, " M"], Int[Array, " M"]]:
        def list_gaussian(slot: Index, state: Listed) -> Listed:
            left, top, width, height = (read(column, slot) for column in box)
            own = tuple(read(column, slot) for column in ellipse)
            first = slot // count * (columns * rows)

            def list_tile(row: Index, column: Index, state: Listed) -> Listed:
                end, tiles, slots = state
                x, y = (TILE_SIZE * index.astype(own[0].dtype) + 0.5 for index in (column, row))
                # A pair that does not touch is overwritten by the next one; the last place of the arrays is spare.
                tiles = write(tiles, end, first + row * columns + column)
                slots = write(slots, end, slot)
                return jnp.minimum(end + reaches_tile(own, x, y).astype(jnp.int32), capacity), tiles, slots

            def list_row(row: Index, state: Listed) -> Listed:
                return loop(left + width, partial(list_tile, row), state, first=left)

            return loop(top + height, list_row, state, first=top)

        tiles = jnp.full(capacity + 1, nowhere, jnp.int32)
        start = (jnp.int32(0), tiles, jnp.zeros_like(tiles))
        end, tiles, slots = loop(box[0].shape[0], list_gaussian, start)
        return write(tiles, end, jnp.int32(nowhere))[:capacity], slots[:capacity]

    return native_call(listed)(tuple(box.T), tuple(ellipse.T))
