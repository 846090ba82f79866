"""The sRGB transfer function and its inverse, for NumPy and jax arrays, and how much to brighten sRGB values.

Powers are taken by logarithms, because XLA's own take five times as long on a CPU.
"""

from typing import TypeVar

import numpy as np
from jaxtyping import Array

MID_GREY = 0.46  # photographers' middle grey, 18 % of linear light, in sRGB

AnyArray = TypeVar("AnyArray", Array, np.ndarray)


def srgb_to_linear(value: AnyArray) -> AnyArray:
    """Inverse of the sRGB transfer function (IEC 61966-2-1), for values [*S] in [0, 1]."""
    xp = value.__array_namespace__()
    return xp.where(value <= 0.04045, value / 12.92, xp.exp(2.4 * xp.log((value + 0.055) / 1.055)))


def linear_to_srgb(value: AnyArray) -> AnyArray:
    """The sRGB transfer function (IEC 61966-2-1), for values [*S] >= 0."""
    xp = value.__array_namespace__()
    low = value <= 0.0031308  # includes 0, where the gradient of the power is not finite
    return xp.where(low, value * 12.92, 1.055 * xp.exp(xp.log(xp.where(low, 1, value)) / 2.4) - 0.055)


def brightening_exponent(mean: float, target: float) -> float:
    """The exponent that would bring values of that mean to the mean `target`, were they all equal; at most 1."""
    return float(np.log(target) / np.log(np.clip(mean, 1e-3, target)))
