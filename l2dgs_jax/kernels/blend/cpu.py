"""Small blocks of tiles, one after the other in one native function: their pixels stay in the L1 cache."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.kernels import loops
from l2dgs_jax.kernels.blend import accelerator
from l2dgs_jax.kernels.blend.blocks import Block, in_blocks
from l2dgs_jax.kernels.blend.walk import Chunking, Sums, add_moments, blend_block, from_moments
from l2dgs_jax.kernels.compilation import native_call
from l2dgs_jax.kernels.tiles import TileLists

BLOCK_SIZE = 8  # tiles
CHUNKING = Chunking(size=8, unroll=False)


def blend(packed: Float[Array, "G D"], lists: TileLists, *, width: int, height: int) -> Float[Array, "T C P"]:
    """See the contract in `__init__`."""
    if not _suits(packed, lists):
        return accelerator.blend(packed, lists, width=width, height=height)
    blocks, _, position = in_blocks(lists, BLOCK_SIZE, width, height, packed.dtype)

    def every_block(packed: Float[Array, "G D"], gaussians: Int[Array, " M"], blocks: Block) -> Float[Array, "S B C P"]:
        return jax.lax.map(lambda block: blend_block(packed, gaussians, block, CHUNKING), blocks)

    tiles = native_call(every_block)(packed, lists.gaussians, blocks)
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
    if not _suits(packed, lists):
        return accelerator.gradient(packed, lists, output, cotangent, width=width, height=height)
    blocks, tiles, _ = in_blocks(lists, BLOCK_SIZE, width, height, packed.dtype)

    def every_block(packed: Float[Array, "G D"], gaussians: Int[Array, " M"], *blocks: Any) -> Sums:
        add = partial(add_moments, chunking=CHUNKING, add_rows=_add_rows)
        return jax.lax.scan(
            lambda sums, block: (add(sums, packed, gaussians, *block), None), jnp.zeros_like(packed), blocks
        )[0]

    return from_moments(
        packed, native_call(every_block)(packed, lists.gaussians, blocks, output[tiles], cotangent[tiles])
    )


def _add_rows(sums: Sums, ids: Int[Array, "K B"], listed: Bool[Array, "K B"], rows: Float[Array, "K B D"]) -> Sums:
    del listed  # rows beyond a list's end are zero, and adding them is faster than leaving them out
    return loops.add_rows(sums, ids, rows)


def _suits(packed: Float[Array, "G D"], lists: TileLists) -> bool:
    """Whether a native call can be used: it needs loops of several steps, and indices that are not all the same."""
    return lists.starts.shape[0] > BLOCK_SIZE and len(packed) > 1
