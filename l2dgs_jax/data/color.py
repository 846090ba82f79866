"""The sRGB transfer function and its inverse."""

import numpy as np
from jaxtyping import Float


def srgb_to_linear(value: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
    """Inverse of the sRGB transfer function (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(value: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
    """The sRGB transfer function (IEC 61966-2-1), value >= 0."""
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * value ** (1 / 2.4) - 0.055)
