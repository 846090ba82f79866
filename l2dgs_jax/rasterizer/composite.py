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
CHUNK = 16  # Gaussians of a list that are blended at a time
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


def _chunk(
    packed: Float[Array, "G D"], lists: TileLists, block: _Block, step: Int[Array, ""] | int
) -> tuple[Int[Array, "K B"], Float[Array, "K B D"], Float[Array, "K B P"]]:
    """The next CHUNK Gaussians of each list of a block: ids, values with means from the tile's middle, and alphas."""
    index = block.starts[None] + step * CHUNK + jnp.arange(CHUNK, dtype=jnp.int32)[:, None]
    listed = index < block.stops[None]
    ids = lists.gaussians[jnp.minimum(index, lists.gaussians.shape[0] - 1)]
    values = packed[ids]
    values = values.at[..., :2].add(-block.centres[None])
    mx, my, a, b, c, opacity = (values[..., column, None] for column in range(GEOMETRY))
    x, y = (axis[None, None] for axis in _pixels(packed.dtype).T)
    dx, dy = x - mx, y - my
    alpha = jnp.where(listed[..., None], opacity, 0) * jnp.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))
    return ids, values, jnp.where(alpha < MIN_ALPHA, 0, jnp.minimum(alpha, MAX_ALPHA))


def _unfinished(block: _Block, step: Int[Array, ""] | int, transmittance: Float[Array, "B P"]):
    listed = step * CHUNK < jnp.max(block.stops - block.starts)
    return listed & ~jnp.all(transmittance <= MIN_TRANSMITTANCE)


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
    channels = packed.shape[1] - GEOMETRY

    def blend(block):
        def body(state):
            step, transmittance, total = state
            _, values, alphas = _chunk(packed, lists, block, step)
            # Unrolled, this fuses into one pass over the chunk; a scan or a matrix product would write it to memory.
            for value, alpha in zip(values, alphas, strict=True):
                after = transmittance * (1 - alpha)
                weight = jnp.where(after <= MIN_TRANSMITTANCE, 0, transmittance * alpha)
                total = total + value[:, GEOMETRY:, None] * weight[:, None]
                transmittance = after
            return step + 1, transmittance, total

        size = block.tiles.shape[0]
        state = 0, jnp.ones((size, PIXELS), packed.dtype), jnp.zeros((size, channels, PIXELS), packed.dtype)
        return jax.lax.while_loop(lambda s: _unfinished(block, s[0], s[1]), body, state)[2]

    output = jax.lax.map(blend, blocks).reshape(-1, channels, PIXELS)[position]
    return output, (packed, lists, output)


def _backward(width, height, residuals, cotangent):
    packed, lists, output = residuals
    blocks, _ = _blocks(lists, width, height, packed.dtype)
    pixels = _pixels(packed.dtype)
    x, y = pixels[:, 0], pixels[:, 1]
    moments = jnp.stack([jnp.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)

    def blend(gradient, block):
        g = cotangent[block.tiles]

        def passing(state, inputs):
            transmittance, behind = state
            alpha, value = inputs
            after = transmittance * (1 - alpha)
            ended = after <= MIN_TRANSMITTANCE
            weight = jnp.where(ended, 0, transmittance * alpha)
            behind = behind - weight * value
            d_alpha = transmittance * value - behind / (1 - alpha)
            return (after, behind), (weight, jnp.where(ended | (alpha >= MAX_ALPHA), 0, -d_alpha * alpha))

        def body(state):
            step, transmittance, behind, gradient = state
            ids, values, alphas = _chunk(packed, lists, block, step)
            value = sum(values[..., GEOMETRY + c, None] * g[None, :, c] for c in range(g.shape[1]))
            (transmittance, behind), (weight, d_sigma) = jax.lax.scan(passing, (transmittance, behind), (alphas, value))

            mx, my, a, b, c, opacity = (values[..., column] for column in range(GEOMETRY))
            m, m_x, m_y, m_xx, m_xy, m_yy = jnp.moveaxis(d_sigma @ moments, -1, 0)
            sx, sy = m_x - mx * m, m_y - my * m
            geometry = [
                -(a * sx + b * sy),
                -(b * sx + c * sy),
                0.5 * (m_xx - mx * (m_x + sx)),
                m_xy - mx * m_y - my * sx,
                0.5 * (m_yy - my * (m_y + sy)),
                -m / jnp.where(opacity == 0, 1, opacity),
            ]
            update = [jnp.stack(geometry, axis=-1), jnp.einsum("kbp,bcp->kbc", weight, g)]
            return step + 1, transmittance, behind, gradient.at[ids].add(jnp.concatenate(update, axis=-1))

        behind = jnp.sum(output[block.tiles] * g, axis=1)
        state = 0, jnp.ones_like(behind), behind, gradient
        return jax.lax.while_loop(lambda s: _unfinished(block, s[0], s[1]), body, state)[3], None

    gradient, _ = jax.lax.scan(blend, jnp.zeros_like(packed), blocks)
    return gradient, jax.tree.map(lambda x: np.zeros(x.shape, jax.dtypes.float0), lists)


composite.defvjp(_forward, _backward)
