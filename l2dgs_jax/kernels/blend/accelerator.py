"""All tiles together: every step of the walk is a few kernel launches over all of them.

Compiled for an accelerator, each step of a loop takes at least one kernel launch, and each test whether a loop
continues is a read by the host: long waits, during which nothing is computed. So all lists are walked at once, to the
end of the longest, and the steps within a chunk are unrolled. docs/kernels.md says what was measured.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.kernels.blend.blocks import Block, tile_centres
from l2dgs_jax.kernels.blend.walk import Chunking, Sums, add_moments, blend_block, from_moments
from l2dgs_jax.kernels.tiles import TileLists

CHUNKING = Chunking(size=16, unroll=True)


def blend(packed: Float[Array, "G D"], lists: TileLists, *, width: int, height: int) -> Float[Array, "T C P"]:
    """See the contract in `__init__`."""
    return blend_block(packed, lists.gaussians, _all_tiles(packed, lists, width, height), CHUNKING)


def gradient(
    packed: Float[Array, "G D"],
    lists: TileLists,
    output: Float[Array, "T C P"],
    cotangent: Float[Array, "T C P"],
    *,
    width: int,
    height: int,
) -> Float[Array, "G D"]:
    """The gradient of `blend` with respect to `packed`."""
    tiles = _all_tiles(packed, lists, width, height)
    nothing = jnp.zeros_like(packed)
    sums = add_moments(nothing, packed, lists.gaussians, tiles, output, cotangent, CHUNKING, _add_rows)
    return from_moments(packed, sums)


def _all_tiles(packed: Float[Array, "G D"], lists: TileLists, width: int, height: int) -> Block:
    tiles = jnp.arange(len(lists.starts), dtype=jnp.int32)
    return Block(lists.starts, lists.stops, tile_centres(tiles, width, height, packed.dtype))


def _add_rows(sums: Sums, ids: Int[Array, "K B"], listed: Bool[Array, "K B"], rows: Float[Array, "K B D"]) -> Sums:
    # Entries beyond the ends of lists all have one index; dropping them avoids contention for its row.
    return sums.at[jnp.where(listed, ids, len(sums))].add(rows, mode="drop")
