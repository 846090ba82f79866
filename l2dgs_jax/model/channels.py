"""The channels that are blended, and the only definition of their order: l, r (three), b1, b2 (Eqs. 5, 6, 8)."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

HAS_BACKGROUND: Bool[np.ndarray, "6"] = np.arange(6) < 4  # the channels of L and R, which the background fills


def pack(
    illumination: Float[Array, "*S"], reflectance: Float[Array, "*S 3"], attenuation: Float[Array, "*S 2"]
) -> Float[Array, "*S 6"]:
    """The channels of every Gaussian, side by side."""
    return jnp.concatenate([illumination[..., None], reflectance, attenuation], axis=-1)


def unpack(features: Float[Array, "*S 6"]) -> tuple[Float[Array, "*S"], Float[Array, "*S 3"], Float[Array, "*S 2"]]:
    """Illumination, reflectance and attenuation out of blended channels."""
    return features[..., 0], features[..., 1:4], features[..., 4:6]
