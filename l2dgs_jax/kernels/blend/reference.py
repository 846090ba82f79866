"""All pairs at once, each with a product over those before it in its list; differentiated by JAX.

Memory grows with the number of pairs times the pixels of a tile.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from l2dgs_jax.kernels.blend.alpha import GEOMETRY_COLUMNS, PIXELS, pixel_offsets
from l2dgs_jax.kernels.blend.blocks import tile_centres
from l2dgs_jax.kernels.tiles import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, TileLists


def blend(packed: Float[Array, "G D"], lists: TileLists, *, width: int, height: int) -> Float[Array, "T C P"]:
    """See the contract in `__init__`."""
    tiles = lists.starts.shape[0]
    position = jnp.arange(lists.gaussians.shape[0], dtype=jnp.int32)
    # The lists lie one after the other: a pair's tile is the last one whose list does not start after the pair.
    tile = jnp.clip(jnp.searchsorted(lists.starts, position, side="right") - 1, 0, tiles - 1)
    listed = (position >= lists.starts[tile]) & (position < lists.stops[tile])
    pairs = packed[lists.gaussians]

    mean = pairs[:, :2] - tile_centres(tile, width, height, packed.dtype)
    dx, dy = (x[None] - m[:, None] for x, m in zip(pixel_offsets(packed.dtype), mean.T, strict=True))
    a, b, c, opacity = (entry[:, None] for entry in pairs[:, 2:GEOMETRY_COLUMNS].T)
    alpha = opacity * jnp.exp(-0.5 * (a * dx**2 + 2 * b * dx * dy + c * dy**2))
    alpha = jnp.where(alpha > MAX_ALPHA, MAX_ALPHA, alpha)  # no gradient where it is clipped
    alpha = jnp.where((alpha < MIN_ALPHA) | ~listed[:, None], 0, alpha)

    first = jnp.broadcast_to((position == lists.starts[tile])[:, None], alpha.shape)
    after = _product_so_far(1 - alpha, first)
    before = jnp.where(first, 1, jnp.roll(after, 1, axis=0))
    weight = jnp.where(after <= MIN_TRANSMITTANCE, 0, before * alpha)
    contribution = pairs[:, GEOMETRY_COLUMNS:, None] * weight[:, None]
    return jnp.zeros((tiles, pairs.shape[1] - GEOMETRY_COLUMNS, PIXELS), packed.dtype).at[tile].add(contribution)


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
    del output
    return jax.vjp(lambda packed: blend(packed, lists, width=width, height=height), packed)[1](cotangent)[0]


def _product_so_far(factors: Float[Array, "M P"], first: Bool[Array, "M P"]) -> Float[Array, "M P"]:
    """For each factor, the product of all factors from the last one marked as `first` up to and including it."""

    def join(
        left: tuple[Float[Array, "..."], Bool[Array, "..."]], right: tuple[Float[Array, "..."], Bool[Array, "..."]]
    ) -> tuple[Float[Array, "..."], Bool[Array, "..."]]:
        return jnp.where(right[1], right[0], left[0] * right[0]), left[1] | right[1]

    return jax.lax.associative_scan(join, (factors, first))[0]
