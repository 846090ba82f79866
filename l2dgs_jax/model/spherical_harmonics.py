"""Real spherical harmonics of the viewing direction (Eq. 2)."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float


def directions(means: Float[Array, "*B N 3"], camera_centre: Float[Array, "*B 3"]) -> Float[Array, "*B N 3"]:
    """Unit vectors from the camera's centre to each Gaussian.

    Gradients flow to both inputs; a Gaussian exactly at the centre has direction (0, 0, 0) and no gradient.

    Args:
        means: centres of the Gaussians, world units.
        camera_centre: world units.
    """
    offsets = means - camera_centre[..., None, :]
    # Sums along short axes are contractions, here and in their gradients: on a CPU, XLA's reductions take far longer.
    squared = jnp.einsum("...i,...i->...", offsets, offsets)
    coincident = squared == 0
    inverse = jnp.where(coincident, 0, 1 / jnp.sqrt(jnp.where(coincident, 1, squared)))
    return jnp.einsum("...,...i->...i", inverse, offsets)


def basis(directions: Float[Array, "*B N 3"], degree: int) -> Float[Array, "*B N J"]:
    """The J = (degree + 1)^2 real spherical harmonics of Eq. 2, in the order l^2 + l + m.

    Signs carry the Condon-Shortley phase (-1)^m, as in 3D Gaussian Splatting (arXiv 2308.04079): the first band is
    proportional to (-y, z, -x). Orthonormal over the sphere. Gradients flow to `directions`.

    Args:
        directions: unit vectors.
        degree: highest band, >= 0.

    Raises:
        ValueError: `degree` is negative.
    """
    if degree < 0:
        raise ValueError(f"the degree of spherical harmonics must be at least 0, not {degree}")
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    bands: dict[tuple[int, int], Array] = {}
    # (x + iy)^m = sin^m(theta) (cos(m phi) + i sin(m phi)); `legendre[l]` is P_l^m(z) / sin^m(theta).
    cosine, sine = jnp.ones_like(z), jnp.zeros_like(z)
    diagonal = 1.0
    for m in range(degree + 1):
        legendre = {m - 1: jnp.zeros_like(z), m: jnp.full_like(z, diagonal)}
        for l in range(m, degree + 1):  # noqa: E741
            if l > m:
                legendre[l] = ((2 * l - 1) * z * legendre[l - 1] - (l + m - 1) * legendre[l - 2]) / (l - m)
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - m) / math.factorial(l + m))
            norm *= (-1) ** m * (math.sqrt(2) if m else 1)
            bands[l, m] = norm * legendre[l] * cosine
            if m:
                bands[l, -m] = norm * legendre[l] * sine
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
        diagonal *= 2 * m + 1
    return jnp.stack([bands[key] for key in sorted(bands)], axis=-1)
