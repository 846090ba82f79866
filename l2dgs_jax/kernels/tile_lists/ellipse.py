"""Whether an ellipse reaches a tile."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from l2dgs_jax.kernels.tiles import TILE_SIZE


def reaches_tile(
    ellipse: tuple[Float[Array, "*S"], ...], x: Float[Array, "*S"], y: Float[Array, "*S"]
) -> Bool[Array, "*S"]:
    """Whether an ellipse (mean, conic, reach) reaches the tile whose first pixel centre is (x, y).

    The tile is taken as the rectangle of its pixel centres. Over a rectangle that excludes its centre, a convex
    quadratic takes its minimum on one of the (at most two) sides that face the centre.
    """
    mean_x, mean_y, a, b, c, reach = ellipse
    low_x, low_y = x - mean_x, y - mean_y
    high_x, high_y = low_x + (TILE_SIZE - 1), low_y + (TILE_SIZE - 1)
    q = lambda x, y: a * x * x + 2 * b * x * y + c * y * y
    near_x, near_y = jnp.clip(0, low_x, high_x), jnp.clip(0, low_y, high_y)
    along_y = q(near_x, jnp.clip(-b * near_x / c, low_y, high_y))
    along_x = q(jnp.clip(-b * near_y / a, low_x, high_x), near_y)
    return ~(jnp.minimum(along_x, along_y) > reach)
