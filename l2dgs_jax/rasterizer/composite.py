"""Front-to-back blending of the tiles' lists, and its gradient, in chunks that fit the cache.

Nothing is stored per pair: the backward pass walks the lists again, front to back, and recomputes alpha.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from l2dgs_jax.rasterizer.intersect import MIN_ALPHA, TILE, TileLists, grid

MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4  # a Gaussian that would leave this little light ends its pixel and is left out
BLOCK = 64  # tiles that walk their lists together
CHUNK = 8  # Gaussians of a list that are blended at a time
PIXELS = TILE * TILE
GEOMETRY = 6  # columns of a packed Gaussian before its features: mean (2), conic (3), opacity


class _Block(NamedTuple):
    """Tiles that walk their lists together: their numbers, their lists and the middle of each."""

    tiles: Int[Array, " B"]
    starts: Int[Array, " B"]
    stops: Int[Array, " B"]
    centres: Float[Array, "B 2"]


def _blocks(lists: TileLists, width: int, height: int, dtype) -> tuple[_Block, Int[Array, " T"]]:
    """All blocks, stacked, and each tile's position in them. Sorting by length makes the lists of a block alike."""
    columns, rows = grid(width, height)
    count = lists.starts.shape[0]
    size = min(BLOCK, count)
    order = jnp.argsort(lists.starts - lists.stops).astype(jnp.int32)
    position = jnp.zeros_like(order).at[order].set(jnp.arange(count, dtype=jnp.int32))
    tiles = jnp.pad(order, (0, -count % size)).reshape(-1, size)
    filler = jnp.arange(tiles.size).reshape(tiles.shape) >= count
    starts = lists.starts[tiles]
    stops = jnp.where(filler, starts, lists.stops[tiles])
    corners = TILE * jnp.stack([tiles % columns, tiles // columns % rows], axis=-1)
    return _Block(tiles, starts, stops, corners.astype(dtype) + TILE / 2), position


def _pixels(dtype) -> Float[Array, "P 2"]:
    """Pixel centres of a tile, measured from its middle."""
    offset = jnp.arange(TILE).astype(dtype) - (TILE - 1) / 2
    return jnp.stack(jnp.meshgrid(offset, offset), axis=-1).reshape(PIXELS, 2)


def _alpha(value: Float[Array, "B D"], pixels: Float[Array, "P 2"]) -> Float[Array, "B P"]:
    """Opacity of one Gaussian per tile at each pixel; exactly zero below MIN_ALPHA."""
    mx, my, a, b, c, opacity = (value[:, column, None] for column in range(GEOMETRY))
    dx, dy = pixels[None, :, 0] - mx, pixels[None, :, 1] - my
    alpha = opacity * jnp.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))
    return jnp.where(alpha < MIN_ALPHA, 0, jnp.minimum(alpha, MAX_ALPHA))


def _walk(packed, lists, block, blend, state, gather=None):
    """Walk the lists of a block front to back until they end or every pixel has.

    Args:
        packed: see `composite`.
        lists: see `composite`.
        block: the tiles.
        blend: (state, values [B D]) -> (state, update), for one Gaussian per tile, means measured from the tile's
            middle. `state[0]` is the transmittance.
        state: what it starts from.
        gather: the sum of each Gaussian's updates so far, [G D]; None if there are no updates.
    """
    longest = jnp.max(block.stops - block.starts)

    def unfinished(carry):
        step, (transmittance, *_), _ = carry
        return (step * CHUNK < longest) & ~jnp.all(transmittance <= MIN_TRANSMITTANCE)

    def body(carry):
        step, state, gather = carry
        index = block.starts[None] + step * CHUNK + jnp.arange(CHUNK, dtype=jnp.int32)[:, None]
        ids = lists.gaussians[jnp.minimum(index, lists.gaussians.shape[0] - 1)]
        values = packed[ids].at[..., :2].add(-block.centres[None])
        values = jnp.where((index < block.stops[None])[..., None], values, 0)
        state, updates = jax.lax.scan(blend, state, values)
        return step + 1, state, None if gather is None else gather.at[ids].add(updates)

    return jax.lax.while_loop(unfinished, body, (0, state, gather))[1:]


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def composite(packed: Float[Array, "G D"], lists: TileLists, width: int, height: int) -> Float[Array, "T C P"]:
    """Blend the feature channels of every tile's list over its 8x8 pixels, nearest first.

    alpha = min(0.999, o exp(-q/2)), skipped below 1/255; the Gaussian that would bring the transmittance to 1e-4 or
    less ends its pixel and is left out (3DGS, arXiv 2308.04079). Gradients flow to `packed`, reverse mode only.

    Args:
        packed: per Gaussian mean (2, pixels), conic (3), opacity, and C = D - 6 features.
        lists: who may touch which tile.
        width: pixels.
        height: pixels.
    """
    return _forward(packed, lists, width, height)[0]


def _forward(packed, lists, width, height):
    blocks, position = _blocks(lists, width, height, packed.dtype)
    pixels = _pixels(packed.dtype)
    channels = packed.shape[1] - GEOMETRY

    def blend(state, value):
        transmittance, total = state
        alpha = _alpha(value, pixels)
        after = transmittance * (1 - alpha)
        weight = jnp.where(after <= MIN_TRANSMITTANCE, 0, transmittance * alpha)
        return (after, total + value[:, GEOMETRY:, None] * weight[:, None]), None

    def draw(block):
        start = jnp.ones((block.tiles.shape[0], PIXELS), packed.dtype)
        total = jnp.zeros((block.tiles.shape[0], channels, PIXELS), packed.dtype)
        return _walk(packed, lists, block, blend, (start, total))[0][1]

    output = jax.lax.map(draw, blocks).reshape(-1, channels, PIXELS)[position]
    return output, (packed, lists, output)


def _backward(width, height, residuals, cotangent):
    packed, lists, output = residuals
    blocks, _ = _blocks(lists, width, height, packed.dtype)
    pixels = _pixels(packed.dtype)
    x, y = pixels.T
    monomials = jnp.stack([jnp.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)

    def draw(gradient, block):
        g = cotangent[block.tiles]

        def blend(state, value):
            transmittance, behind = state
            alpha = _alpha(value, pixels)
            after = transmittance * (1 - alpha)
            ended = after <= MIN_TRANSMITTANCE
            weight = jnp.where(ended, 0, transmittance * alpha)
            seen = jnp.sum(value[:, GEOMETRY:, None] * g, axis=1)
            # What the pixel's output owes to the Gaussians behind this one scales with 1 - alpha.
            behind = behind - weight * seen
            d_alpha = transmittance * seen - behind / (1 - alpha)
            d_sigma = jnp.where(ended | (alpha >= MAX_ALPHA), 0, -d_alpha * alpha)

            mx, my, a, b, c, opacity = (value[:, column] for column in range(GEOMETRY))
            m, m_x, m_y, m_xx, m_xy, m_yy = (d_sigma @ monomials).T
            s_x, s_y = m_x - mx * m, m_y - my * m
            geometry = [
                -(a * s_x + b * s_y),
                -(b * s_x + c * s_y),
                0.5 * (m_xx - mx * (m_x + s_x)),
                m_xy - mx * m_y - my * s_x,
                0.5 * (m_yy - my * (m_y + s_y)),
                -m / jnp.where(opacity == 0, 1, opacity),
            ]
            features = jnp.einsum("bp,bcp->bc", weight, g)
            return (after, behind), jnp.concatenate([jnp.stack(geometry, axis=-1), features], axis=-1)

        behind = jnp.sum(output[block.tiles] * g, axis=1)
        return _walk(packed, lists, block, blend, (jnp.ones_like(behind), behind), gradient)[1], None

    gradient, _ = jax.lax.scan(draw, jnp.zeros_like(packed), blocks)
    return gradient, jax.tree.map(lambda x: np.zeros(x.shape, jax.dtypes.float0), lists)


composite.defvjp(_forward, _backward)
