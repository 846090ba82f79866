"""Blocks of very many tiles: every step of a walk is a few kernel launches over all of them.

Never measured on an accelerator. Compiled for one, each step of a loop takes at least one kernel launch, and each test
whether a loop continues is a read by the host, so blocks are large and the steps within a chunk are unrolled.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.kernels.blend.blocks import in_blocks
from l2dgs_jax.kernels.blend.walk import Chunking, Sums, add_moments, blend_block, from_moments
from l2dgs_jax.kernels.tiles import TileLists

BLOCK_SIZE = 2048  # tiles
CHUNKING = Chunking(size=8, unroll=True)


def blend(packed: Float[Array, "G D"], lists: TileLists, *, width: int, height: int) -> Float[Array, "T C P"]:
    """See the contract in `__init__`."""
    blocks, _, position = in_blocks(lists, BLOCK_SIZE, width, height, packed.dtype)
    tiles = jax.lax.map(lambda block: blend_block(packed, lists.gaussians, block, CHUNKING), blocks)
    return tiles.reshape(-1, *tiles.shape[2:])[position]


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
    blocks, tiles, _ = in_blocks(lists, BLOCK_SIZE, width, height, packed.dtype)
    add = partial(add_moments, chunking=CHUNKING, add_rows=_add_rows)
    sums, _ = jax.lax.scan(
        lambda sums, block: (add(sums, packed, lists.gaussians, *block), None),
        jnp.zeros_like(packed),
        (blocks, output[tiles], cotangent[tiles]),
    )
    return from_moments(packed, sums)


def _add_rows(sums: Sums, ids: Int[Array, "K B"], listed: Bool[Array, "K B"], rows: Float[Array, "K B D"]) -> Sums:
    # Entries beyond the ends of lists all have one index; dropping them avoids contention for its row.
    return sums.at[jnp.where(listed, ids, len(sums))].add(rows, mode="drop")
