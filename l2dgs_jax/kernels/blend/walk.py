"""The front-to-back walk along the lists of a block of tiles, which the CPU and accelerator forms share.

The gradient walks the lists again, front to back, and recomputes alpha: the contribution of the Gaussians behind the
current one is what is left of the pixel's output after subtracting those up to it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.kernels.blend.alpha import GEOMETRY_COLUMNS, PIXELS, alpha, pixel_offsets
from l2dgs_jax.kernels.blend.blocks import Block
from l2dgs_jax.kernels.tiles import MAX_ALPHA, MIN_TRANSMITTANCE, TILE_SIZE

Sums = Float[Array, "G D"]
AddRows = Callable[[Sums, Int[Array, "K B"], Bool[Array, "K B"], Float[Array, "K B D"]], Sums]


class Chunking(NamedTuple):
    """How many Gaussians of each list are walked between two tests whether the block has ended; whether unrolled."""

    size: int
    unroll: bool


def blend_block(
    packed: Float[Array, "G D"], gaussians: Int[Array, " M"], block: Block, chunking: Chunking
) -> Float[Array, "B C P"]:
    """The blended features of the tiles of a block."""
    channels = packed.shape[1] - GEOMETRY_COLUMNS

    def add(state: Any, value: Float[Array, "B D"]) -> tuple[Any, None]:
        transmittance, total = state
        opaque = alpha(value)
        after = transmittance * (1 - opaque)
        weight = jnp.where(after <= MIN_TRANSMITTANCE, 0, transmittance * opaque)
        return (after, total + value[:, GEOMETRY_COLUMNS:, None] * weight[:, None]), None

    size = block.starts.shape[0]
    state = jnp.ones((size, PIXELS), packed.dtype), jnp.zeros((size, channels, PIXELS), packed.dtype)
    return _walk(packed, gaussians, block, chunking, add, state)[0][1]


def add_moments(
    sums: Sums,
    packed: Float[Array, "G D"],
    gaussians: Int[Array, " M"],
    block: Block,
    image: Float[Array, "B C P"],
    g: Float[Array, "B C P"],
    chunking: Chunking,
    add_rows: AddRows,
) -> Sums:
    """Add a block's moments and feature gradients to `sums`, from which `from_moments` makes the gradient of `packed`.

    Args:
        sums: of the blocks before.
        packed: see `blend`.
        gaussians: all lists, one after the other.
        block: the tiles.
        image: the blended features of the tiles.
        g: cotangents of `image`.
        chunking: how to walk.
        add_rows: (sums, ids, whether each id belongs to a list, rows) -> sums with the rows added.
    """
    channels = range(packed.shape[1] - GEOMETRY_COLUMNS)
    x, y = pixel_offsets(packed.dtype)
    powers = np.stack([np.ones_like(y), y, y * y])
    # Sums over pixels are spelled out. Those over rows are done for each Gaussian, as eight additions of vectors of a
    # row's eight pixels; those over columns are done together at the end of a chunk.
    over_rows = lambda x: sum(x[..., TILE_SIZE * row : TILE_SIZE * (row + 1)] for row in range(TILE_SIZE))
    over_columns = lambda x: sum(x[..., column] for column in range(TILE_SIZE))

    def pull(state: Any, value: Float[Array, "B D"]) -> tuple[Any, Any]:
        transmittance, behind = state
        opaque = alpha(value)
        after = transmittance * (1 - opaque)
        ended = after <= MIN_TRANSMITTANCE
        weight = jnp.where(ended, 0, transmittance * opaque)
        seen = sum(value[:, GEOMETRY_COLUMNS + channel, None] * g[:, channel] for channel in channels)
        # The contribution of the Gaussians behind this one scales with 1 - alpha.
        behind = behind - weight * seen
        d_alpha = transmittance * seen - behind / (1 - opaque)
        d_sigma = jnp.where(ended | (opaque >= MAX_ALPHA), 0, -d_alpha * opaque)
        return (after, behind), (over_rows(d_sigma[:, None] * powers[None]), over_rows(weight[:, None] * g))

    def consume(sums: Sums, ids: Array, listed: Array, values: Float[Array, "K B D"], updates: Any) -> Sums:
        moments, features = updates
        row = x[:TILE_SIZE][None, None]
        m, m_x, m_xx = (over_columns(moments[..., 0, :] * factor) for factor in (1, row, row * row))
        m_y, m_xy = (over_columns(moments[..., 1, :] * factor) for factor in (1, row))
        m_yy = over_columns(moments[..., 2, :])
        # From moments about the middle of the tile to moments about the mean.
        mx, my = values[..., 0], values[..., 1]
        s_x, s_y = m_x - mx * m, m_y - my * m
        entries = (m, s_x, s_y, m_xx - mx * (m_x + s_x), m_xy - mx * m_y - my * s_x, m_yy - my * (m_y + s_y))
        moments = jnp.stack(entries, axis=-1)
        return add_rows(sums, ids, listed, jnp.concatenate([moments, over_columns(features)], axis=-1))

    behind = sum(image[:, channel] * g[:, channel] for channel in channels)
    return _walk(packed, gaussians, block, chunking, pull, (jnp.ones_like(behind), behind), consume, sums)[1]


def from_moments(packed: Float[Array, "G D"], sums: Sums) -> Float[Array, "G D"]:
    """The gradient of `packed` from the moments (1, x, y, xx, xy, yy) of dL/dsigma about each mean, sigma = q / 2."""
    a, b, c, opacity = packed[:, 2:GEOMETRY_COLUMNS].T
    m, x, y, xx, xy, yy = sums[:, :GEOMETRY_COLUMNS].T
    geometry = [-(a * x + b * y), -(b * x + c * y), 0.5 * xx, xy, 0.5 * yy, -m / jnp.where(opacity == 0, 1, opacity)]
    return jnp.concatenate([jnp.stack(geometry, axis=-1), sums[:, GEOMETRY_COLUMNS:]], axis=-1)


def _walk(
    packed: Float[Array, "G D"],
    gaussians: Int[Array, " M"],
    block: Block,
    chunking: Chunking,
    visit: Callable[[Any, Float[Array, "B D"]], tuple[Any, Any]],
    state: Any,
    consume: Callable[..., Any] = lambda sums, *_: sums,
    sums: Any = None,
) -> tuple[Any, Any]:
    """Walk the lists of a block front to back until all lists or all pixels have ended.

    Args:
        packed: see `blend`.
        gaussians: all lists, one after the other.
        block: the tiles.
        chunking: how to walk.
        visit: (state, values [B D]) -> (state, updates), for one Gaussian per tile, its mean relative to the tile's
            middle. `state[0]` is the transmittance.
        state: initial state of `visit`.
        consume: (sums, ids [K B], whether each id belongs to a list, values [K B D], updates [K ...]) -> sums, called
            for every chunk of K Gaussians.
        sums: initial sums of `consume`.

    Returns:
        The final state and sums.
    """
    longest = jnp.max(block.stops - block.starts)

    def unfinished(carry: Any) -> Bool[Array, ""]:
        step, (transmittance, *_), _ = carry
        return (step * chunking.size < longest) & ~jnp.all(transmittance <= MIN_TRANSMITTANCE)

    def body(carry: Any) -> Any:
        step, state, sums = carry
        index = block.starts[None] + step * chunking.size + jnp.arange(chunking.size, dtype=jnp.int32)[:, None]
        listed = index < block.stops[None]
        ids = gaussians[jnp.minimum(index, gaussians.shape[0] - 1)]
        values = packed[ids].at[..., :2].add(-block.centres[None])
        values = jnp.where(listed[..., None], values, 0)
        state, updates = jax.lax.scan(visit, state, values, unroll=chunking.unroll)
        return step + 1, state, consume(sums, ids, listed, values, updates)

    return jax.lax.while_loop(unfinished, body, (0, state, sums))[1:]
