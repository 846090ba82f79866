"""Front-to-back blending of the tiles' lists, and its gradient, in chunks that fit the cache."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.rasterizer.intersect import MIN_ALPHA, TILE, TileLists, grid

MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4  # a Gaussian that would leave less light than this ends its pixel and is left out
BLOCK = 64  # tiles that walk their lists together
CHUNK = 16  # Gaussians of a list blended at a time
PIXELS = TILE * TILE


class _Block(NamedTuple):
    """Tiles of one block: their numbers, lists and pixel centres."""

    tiles: Int[Array, "B"]
    starts: Int[Array, "B"]
    stops: Int[Array, "B"]
    x: Float[Array, "B P"]
    y: Float[Array, "B P"]


def _blocks(lists: TileLists, width: int, height: int, dtype) -> tuple[_Block, Int[Array, "T"]]:
    """Tiles grouped by the length of their lists, [blocks, B], and the position of each tile in that order."""
    columns, rows = grid(width, height)
    count = lists.starts.shape[0]
    size = min(BLOCK, count)
    order = jnp.argsort(lists.starts - lists.stops)
    position = jnp.zeros_like(order).at[order].set(jnp.arange(count, dtype=order.dtype))
    order = jnp.pad(order, (0, -count % size)).reshape(-1, size)
    real = (jnp.arange(order.size) < count).reshape(order.shape)
    starts = lists.starts[order]
    offset = np.arange(PIXELS)
    corner = lambda tile: (TILE * tile[..., None]).astype(dtype) + 0.5
    x = corner(order % columns) + (offset % TILE).astype(dtype)[None, None]
    y = corner(order // columns % rows) + (offset // TILE).astype(dtype)[None, None]
    return _Block(order, starts, jnp.where(real, lists.stops[order], starts), x, y), position


class _Chunk(NamedTuple):
    """The next CHUNK Gaussians of each list of a block at each pixel."""

    gaussians: Int[Array, "B K"]
    values: Float[Array, "B K C"]
    dx: Float[Array, "B K P"]
    dy: Float[Array, "B K P"]
    falloff: Float[Array, "B K P"]
    alpha: Float[Array, "B K P"]
    clipped: Bool[Array, "B K P"]
    before: Float[Array, "B K P"]
    weight: Float[Array, "B K P"]


def _chunk(packed, lists, block, step, transmittance):
    index = block.starts[:, None] + step * CHUNK + jnp.arange(CHUNK, dtype=jnp.int32)[None]
    listed = index < block.stops[:, None]
    gaussians = lists.gaussians[jnp.minimum(index, lists.gaussians.shape[0] - 1)]
    values = packed[gaussians]
    mx, my, a, b, c, o = (values[..., k, None] for k in range(6))
    o = jnp.where(listed[..., None], o, 0)
    dx, dy = block.x[:, None] - mx, block.y[:, None] - my
    falloff = jnp.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))
    raw = o * falloff
    clipped = raw > MAX_ALPHA
    alpha = jnp.where(raw < MIN_ALPHA, 0, jnp.minimum(raw, MAX_ALPHA))
    after = transmittance[:, None] * jax.lax.associative_scan(jnp.multiply, 1 - alpha, axis=1)
    before = jnp.concatenate([transmittance[:, None], after[:, :-1]], axis=1)
    weight = jnp.where(after <= MIN_TRANSMITTANCE, 0, before * alpha)
    return _Chunk(gaussians, values, dx, dy, falloff, alpha, clipped, before, weight), after[:, -1]


def _unfinished(block, step, transmittance):
    left = jnp.max(block.stops - block.starts) > step * CHUNK
    return left & ~jnp.all(transmittance <= MIN_TRANSMITTANCE)


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def composite(packed: Float[Array, "G D"], lists: TileLists, width: int, height: int) -> Float[Array, "T C P"]:
    """Blend."""
    return _forward(packed, lists, width, height)[0]


def _forward(packed, lists, width, height):
    blocks, position = _blocks(lists, width, height, packed.dtype)
    channels = packed.shape[1] - 6

    def blend(block):
        def body(state):
            step, transmittance, total = state
            chunk, transmittance = _chunk(packed, lists, block, step, transmittance)
            total = total + jnp.einsum("bkc,bkp->bcp", chunk.values[..., 6:], chunk.weight)
            return step + 1, transmittance, total

        start = jnp.ones_like(block.x)
        state = (0, start, jnp.zeros((start.shape[0], channels, PIXELS), start.dtype))
        return jax.lax.while_loop(lambda s: _unfinished(block, s[0], s[1]), body, state)[2]

    output = jax.lax.map(blend, blocks).reshape(-1, channels, PIXELS)[position]
    return output, (packed, lists, output)


def _backward(width, height, residuals, cotangent):
    packed, lists, output = residuals
    blocks, _ = _blocks(lists, width, height, packed.dtype)
    behind = jnp.sum(output * cotangent, axis=1)

    def blend(gradient, block):
        g = cotangent[block.tiles]

        def body(state):
            step, transmittance, behind, gradient = state
            chunk, transmittance = _chunk(packed, lists, block, step, transmittance)
            value = jnp.einsum("bkc,bcp->bkp", chunk.values[..., 6:], g)
            seen = jax.lax.associative_scan(jnp.add, chunk.weight * value, axis=1)
            d_alpha = chunk.before * value - (behind[:, None] - seen) / (1 - chunk.alpha)
            d_alpha = jnp.where((chunk.weight > 0) & ~chunk.clipped, d_alpha, 0)
            _, _, a, b, c, _ = (chunk.values[..., k] for k in range(6))
            d_sigma = -d_alpha * chunk.alpha
            sx, sy = jnp.sum(d_sigma * chunk.dx, -1), jnp.sum(d_sigma * chunk.dy, -1)
            sxx = jnp.sum(d_sigma * chunk.dx * chunk.dx, -1)
            sxy = jnp.sum(d_sigma * chunk.dx * chunk.dy, -1)
            syy = jnp.sum(d_sigma * chunk.dy * chunk.dy, -1)
            d_opacity = jnp.sum(d_alpha * chunk.falloff, -1)
            d_geometry = jnp.stack(
                [-(a * sx + b * sy), -(c * sy + b * sx), 0.5 * sxx, sxy, 0.5 * syy, d_opacity], axis=-1
            )
            d_features = jnp.einsum("bkp,bcp->bkc", chunk.weight, g)
            update = jnp.concatenate([d_geometry, d_features], axis=-1)
            return step + 1, transmittance, behind - seen[:, -1], gradient.at[chunk.gaussians].add(update)

        start = jnp.ones_like(block.x)
        state = (0, start, behind[block.tiles], gradient)
        return jax.lax.while_loop(lambda s: _unfinished(block, s[0], s[1]), body, state)[3], None

    gradient, _ = jax.lax.scan(blend, jnp.zeros_like(packed), blocks)
    none = jax.tree.map(lambda x: np.zeros(x.shape, jax.dtypes.float0), lists)
    return gradient, none


composite.defvjp(_forward, _backward)
