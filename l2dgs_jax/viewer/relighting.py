"""Relighting a decomposed view: the formula of the low-light image (Eq. 9) with adjustable exponents."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.data.color import linear_to_srgb, srgb_to_linear
from l2dgs_jax.model.decomposition import as_light, full_light, power, product
from l2dgs_jax.types import Decomposition

LUMINANCE: Float[np.ndarray, "3"] = np.array([0.2126, 0.7152, 0.0722])  # of linear red, green and blue (Rec. 709)
FULL_WARMTH = 0.8  # stops between the gains of red and green, and of green and blue, at warmth 1


class Light(NamedTuple):
    """How a view is lit; the default is the well-lit image.

    Attributes:
        brightness: 0 is as dark as filmed, 1 well-lit, and more is still brighter: the exponents of R and L are B1 and
            B2 to the power of 1 - brightness.
        shading: factor on the exponent of L; 0 gives the same light everywhere.
        gain: on linear light, stops.
        warmth: from -1, blue, to 1, orange.
        tint: from -1, green, to 1, magenta.
    """

    brightness: Any = 1.0
    shading: Any = 1.0
    gain: Any = 0.0
    warmth: Any = 0.0
    tint: Any = 0.0


@partial(jax.jit, static_argnames="cfg")
def relit(images: Decomposition, light: Light, cfg: ModelConfig) -> Float[Array, "H W 3"]:
    """L^(shading B2^d) R^(B1^d) with d = 1 - brightness, then white balance and gain in linear light.

    Args:
        images: decomposition of a view.
        light: how it is lit.
        cfg: settings of the model: what is raised to powers, and which L is full light.

    Returns:
        sRGB values in [0, 1].
    """
    exponents = images.attenuation ** (1 - light.brightness)
    full = full_light(cfg) ** (-light.shading * light.brightness)
    illumination = full * power(images.illumination, light.shading * exponents[..., 1])
    image = product(illumination, power(as_light(images.reflectance, cfg), exponents[..., :1]), cfg)
    gains = white_balance(light.warmth, light.tint) * 2.0**light.gain
    return linear_to_srgb(jnp.clip(srgb_to_linear(image) * gains[None, None].astype(image.dtype), 0, 1))


def white_balance(warmth: Any, tint: Any) -> Float[Array, "3"]:
    """Gains of linear red, green and blue that preserve the luminance of grey; for the arguments see `Light`."""
    gains = 2.0 ** (FULL_WARMTH * jnp.stack([warmth + tint / 2, -tint / 2, -warmth + tint / 2]))
    return gains / (LUMINANCE * gains).sum()
