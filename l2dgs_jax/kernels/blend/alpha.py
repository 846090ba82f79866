"""Opacity of a Gaussian at the pixels of a tile."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import DTypeLike

from l2dgs_jax.kernels.tiles import MAX_ALPHA, MIN_ALPHA, TILE_SIZE

PIXELS = TILE_SIZE * TILE_SIZE
GEOMETRY_COLUMNS = 6  # of a packed Gaussian, before its features: mean (2), conic (3), opacity


def pixel_offsets(dtype: DTypeLike) -> Float[np.ndarray, "2 P"]:
    """The x and y of the pixel centres of a tile, relative to its middle."""
    offsets = np.arange(TILE_SIZE) - (TILE_SIZE - 1) / 2
    return np.stack(np.meshgrid(offsets, offsets)).reshape(2, PIXELS).astype(dtype)


def alpha(value: Float[Array, "B D"]) -> Float[Array, "B P"]:
    """Alpha of one packed Gaussian per tile, whose mean is relative to the tile's middle; exactly 0 below MIN_ALPHA."""
    mx, my, a, b, c, opacity = (value[:, column, None] for column in range(GEOMETRY_COLUMNS))
    x, y = pixel_offsets(value.dtype)
    dx, dy = x[None] - mx, y[None] - my
    alpha = opacity * jnp.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy))
    return jnp.where(alpha < MIN_ALPHA, 0, jnp.minimum(alpha, MAX_ALPHA))
