"""Front-to-back blending of the tiles' lists, and its gradient.

Nothing is stored per pair: the backward pass walks the lists again, front to back, and recomputes alpha.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from l2dgs_jax.native import add_rows_in_turn, by_platform, one_function
from l2dgs_jax.rasterizer.intersect import MIN_ALPHA, TILE, TileLists, grid

MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4  # a Gaussian that would leave this little light ends its pixel and is left out
CHUNK = 8  # Gaussians of a list that are blended between two looks at whether the block has ended
PIXELS = TILE * TILE
GEOMETRY = 6  # columns of a packed Gaussian before its features: mean (2), conic (3), opacity

# Tiles that walk their lists together: as many as a core's first cache holds, or enough to keep an accelerator busy.
CPU_BLOCK, ACCELERATOR_BLOCK = 8, 512


class _Block(NamedTuple):
    """Tiles that walk their lists together: where their lists start and stop, and the middle of each tile."""

    starts: Int[Array, "*S B"]
    stops: Int[Array, "*S B"]
    centres: Float[Array, "*S B 2"]


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def composite(packed: Float[Array, "G D"], lists: TileLists, width: int, height: int) -> Float[Array, "T C P"]:
    """Blend the feature channels of every tile's list over its 8x8 pixels, nearest first.

    alpha = min(0.999, o exp(-q/2)), skipped below 1/255; the Gaussian that would bring the transmittance to 1e-4 or
    less ends its pixel and is left out (3DGS, arXiv 2308.04079). Gradients flow to `packed`, reverse mode only. A
    vmapped call blends the tiles of all members as one larger image.

    Args:
        packed: per Gaussian mean (2, pixels), conic (3), opacity, and C = D - 6 features.
        lists: who may touch which tile.
        width: pixels.
        height: pixels.
    """
    return _forward(packed, lists, width, height)[0]


def _forward(packed, lists, width, height):
    output = _by_platform(_blend, width, height)(packed, lists)
    return output, (packed, lists, output)


def _backward(width, height, residuals, cotangent):
    packed, lists, output = residuals
    sums = _by_platform(_moments, width, height)(packed, lists, output, cotangent)
    return _from_moments(packed, sums), jax.tree.map(lambda x: np.zeros(x.shape, jax.dtypes.float0), lists)


composite.defvjp(_forward, _backward)


def _by_platform(draw: Callable[..., Array], width: int, height: int) -> Callable[..., Array]:
    """`draw` as a function of (packed, lists, ...), in the form that suits where it runs; folded under vmap."""
    columns, rows = grid(width, height)

    def cpu(packed, lists, *images):
        if lists.starts.shape[0] <= CPU_BLOCK:  # `one_function` wants loops that the compiler cannot unroll
            return default(packed, lists, *images)
        sequential = one_function(partial(draw, add_rows=add_rows_in_turn))
        return _in_blocks(sequential, CPU_BLOCK, packed, lists, images, columns, rows)

    def default(packed, lists, *images):
        parallel = partial(draw, add_rows=lambda table, ids, rows: table.at[ids].add(rows))
        return _in_blocks(parallel, ACCELERATOR_BLOCK, packed, lists, images, columns, rows)

    return _fold(lambda *arguments: by_platform(*arguments, cpu=cpu, default=default))


def _fold(function: Callable[..., Array]) -> Callable[..., Array]:
    """The same function of (packed, lists, ...); vmapped, it is called once, with the members one after the other.

    A loop that is vmapped as it stands runs until its slowest member ends, and selects what to keep in every step.
    """
    folded = jax.custom_batching.custom_vmap(function)

    @folded.def_vmap
    def rule(members, batched, *arguments):
        widen = lambda x, is_batched: x if is_batched else jnp.broadcast_to(x[None], (members, *x.shape))
        packed, lists, *images = jax.tree.map(widen, arguments, tuple(batched))
        first = lambda size: size * jnp.arange(members, dtype=jnp.int32)[:, None]
        count, capacity = packed.shape[1], lists.gaussians.shape[1]
        lists = TileLists(lists.gaussians + first(count), lists.starts + first(capacity), lists.stops + first(capacity))
        flat = lambda x: x.reshape(-1, *x.shape[2:])
        result = folded(flat(packed), jax.tree.map(flat, lists), *map(flat, images))
        return result.reshape(members, -1, *result.shape[1:]), True

    return folded


def _in_blocks(draw, size, packed, lists, images, columns, rows):
    """Call `draw` with the tiles in blocks. Sorting the tiles by length makes the lists of a block alike.

    What comes of images is summed per Gaussian; without any it is drawn per tile, and put back in the tiles' order.
    """
    count = lists.starts.shape[0]
    size = min(size, count)
    order = jnp.argsort(lists.starts - lists.stops).astype(jnp.int32)
    tiles = jnp.pad(order, (0, -count % size)).reshape(-1, size)
    filler = jnp.arange(tiles.size).reshape(tiles.shape) >= count
    starts = lists.starts[tiles]
    stops = jnp.where(filler, starts, lists.stops[tiles])
    corners = TILE * jnp.stack([tiles % columns, tiles // columns % rows], axis=-1)
    blocks = _Block(starts, stops, corners.astype(packed.dtype) + TILE / 2)
    result = draw(packed, lists.gaussians, blocks, *(image[tiles] for image in images))
    if images:
        return result
    position = jnp.zeros_like(order).at[order].set(jnp.arange(count, dtype=jnp.int32))
    return result.reshape(-1, *result.shape[2:])[position]


def _pixels(dtype) -> Float[np.ndarray, "2 P"]:
    """The x and the y of the pixel centres of a tile, measured from its middle."""
    offsets = np.arange(TILE) - (TILE - 1) / 2
    return np.stack(np.meshgrid(offsets, offsets)).reshape(2, PIXELS).astype(dtype)


def _alpha(value: Float[Array, "B D"]) -> Float[Array, "B P"]:
    """Opacity of one Gaussian per tile at each pixel; exactly zero below MIN_ALPHA."""
    mx, my, a, b, c, opacity = (value[:, column, None] for column in range(GEOMETRY))
    x, y = _pixels(value.dtype)
    dx, dy = x[None] - mx, y[None] - my
    alpha = opacity * jnp.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))
    return jnp.where(alpha < MIN_ALPHA, 0, jnp.minimum(alpha, MAX_ALPHA))


def _walk(packed, gaussians, block, blend, state, consume=lambda sums, ids, values, updates: sums, sums=None):
    """Walk the lists of a block front to back until they end or every pixel has.

    Args:
        packed: see `composite`.
        gaussians: all lists, one after the other.
        block: the tiles.
        blend: (state, values [B D]) -> (state, updates), for one Gaussian per tile, means measured from the tile's
            middle. `state[0]` is the transmittance.
        state: what it starts from.
        consume: (sums, ids [K B], values [K B D], updates [K ...]) -> sums, for every chunk of K Gaussians.
        sums: what it starts from.
    """
    longest = jnp.max(block.stops - block.starts)

    def unfinished(carry):
        step, (transmittance, *_), _ = carry
        return (step * CHUNK < longest) & ~jnp.all(transmittance <= MIN_TRANSMITTANCE)

    def body(carry):
        step, state, sums = carry
        index = block.starts[None] + step * CHUNK + jnp.arange(CHUNK, dtype=jnp.int32)[:, None]
        ids = gaussians[jnp.minimum(index, gaussians.shape[0] - 1)]
        values = packed[ids].at[..., :2].add(-block.centres[None])
        values = jnp.where((index < block.stops[None])[..., None], values, 0)
        state, updates = jax.lax.scan(blend, state, values)
        return step + 1, state, consume(sums, ids, values, updates)

    return jax.lax.while_loop(unfinished, body, (0, state, sums))[1:]


def _blend(packed, gaussians, blocks, *, add_rows):
    del add_rows
    channels = packed.shape[1] - GEOMETRY

    def blend(state, value):
        transmittance, total = state
        alpha = _alpha(value)
        after = transmittance * (1 - alpha)
        weight = jnp.where(after <= MIN_TRANSMITTANCE, 0, transmittance * alpha)
        return (after, total + value[:, GEOMETRY:, None] * weight[:, None]), None

    def draw(block):
        size = block.starts.shape[0]
        state = jnp.ones((size, PIXELS), packed.dtype), jnp.zeros((size, channels, PIXELS), packed.dtype)
        return _walk(packed, gaussians, block, blend, state)[0][1]

    return jax.lax.map(draw, blocks)


def _moments(packed, gaussians, blocks, output, cotangent, *, add_rows):
    """The gradient of `composite`, but for what `_from_moments` does."""
    channels = range(packed.shape[1] - GEOMETRY)
    x, y = _pixels(packed.dtype)
    powers = np.stack([np.ones_like(y), y, y * y])
    # Sums over pixels are spelled out, rows first and columns last: as vectors of a row's eight pixels, the rows cost
    # eight additions, and what is left of the columns waits for the end of the chunk.
    over_rows = lambda x: sum(x[..., TILE * row : TILE * (row + 1)] for row in range(TILE))
    over_columns = lambda x: sum(x[..., column] for column in range(TILE))

    def draw(sums, part):
        block, image, g = part

        def blend(state, value):
            transmittance, behind = state
            alpha = _alpha(value)
            after = transmittance * (1 - alpha)
            ended = after <= MIN_TRANSMITTANCE
            weight = jnp.where(ended, 0, transmittance * alpha)
            seen = sum(value[:, GEOMETRY + channel, None] * g[:, channel] for channel in channels)
            # What the pixel's output owes to the Gaussians behind this one scales with 1 - alpha.
            behind = behind - weight * seen
            d_alpha = transmittance * seen - behind / (1 - alpha)
            d_sigma = jnp.where(ended | (alpha >= MAX_ALPHA), 0, -d_alpha * alpha)
            return (after, behind), (over_rows(d_sigma[:, None] * powers[None]), over_rows(weight[:, None] * g))

        def consume(sums, ids, values, updates):
            moments, features = updates
            row = x[:TILE][None, None]
            m, m_x, m_xx = (over_columns(moments[..., 0, :] * factor) for factor in (1, row, row * row))
            m_y, m_xy = (over_columns(moments[..., 1, :] * factor) for factor in (1, row))
            m_yy = over_columns(moments[..., 2, :])
            # From around the middle of the tile to around the mean.
            mx, my = values[..., 0], values[..., 1]
            s_x, s_y = m_x - mx * m, m_y - my * m
            entries = (m, s_x, s_y, m_xx - mx * (m_x + s_x), m_xy - mx * m_y - my * s_x, m_yy - my * (m_y + s_y))
            moments = jnp.stack(entries, axis=-1)
            return add_rows(sums, ids, jnp.concatenate([moments, over_columns(features)], axis=-1))

        behind = sum(image[:, channel] * g[:, channel] for channel in channels)
        return _walk(packed, gaussians, block, blend, (jnp.ones_like(behind), behind), consume, sums)[1], None

    return jax.lax.scan(draw, jnp.zeros_like(packed), (blocks, output, cotangent))[0]


def _from_moments(packed: Float[Array, "G D"], sums: Float[Array, "G D"]) -> Float[Array, "G D"]:
    """The gradient in `packed` from the moments (0, x, y, xx, xy, yy) of dL/dsigma around each mean, sigma = q / 2."""
    a, b, c, opacity = packed[:, 2:GEOMETRY].T
    m, x, y, xx, xy, yy = sums[:, :GEOMETRY].T
    geometry = [-(a * x + b * y), -(b * x + c * y), 0.5 * xx, xy, 0.5 * yy, -m / jnp.where(opacity == 0, 1, opacity)]
    return jnp.concatenate([jnp.stack(geometry, axis=-1), sums[:, GEOMETRY:]], axis=-1)
