"""Projection of 3D Gaussians onto the image plane: elliptical weighted averaging (EWA)."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

NEAR = 0.01  # world units; Gaussians whose centre is nearer are not drawn
BLUR = 0.3  # pixels^2 added to the projected covariance, so that no Gaussian falls between pixels
FIELD_MARGIN = 0.3  # of half the field of view: how far outside the image the Jacobian still follows the centre


class Projected(NamedTuple):
    """Gaussians on the image plane.

    Attributes:
        means2d: centres in pixels.
        covariances2d: (xx, xy, yy) in pixels^2, blur included.
        conics: (xx, xy, yy) of the inverse of the covariance, pixels^-2.
        depths: distance along the camera's z axis, world units.
        visible: whether the centre lies beyond the near plane; values of other rows are finite and meaningless.
    """

    means2d: Float[Array, "*B N 2"]
    covariances2d: Float[Array, "*B N 3"]
    conics: Float[Array, "*B N 3"]
    depths: Float[Array, "*B N"]
    visible: Bool[Array, "*B N"]


def rotations(quats: Float[Array, "N 4"]) -> Float[Array, "3 3 N"]:
    """Rotation matrices of quaternions (wxyz) of any norm; a zero quaternion is the identity and has no gradient.

    The Gaussians are the last axis: every entry is one vector, and arithmetic with entries is what CPUs are fast at.
    """
    w, x, y, z = quats.T
    squared = w * w + x * x + y * y + z * z
    zero = squared <= 1e-24
    inverse_norm = jnp.where(zero, 0, 1 / jnp.sqrt(jnp.where(zero, 1, squared)))
    w, x, y, z = (part * inverse_norm for part in (w, x, y, z))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


def project(
    means: Float[Array, "N 3"],
    quats: Float[Array, "N 4"],
    scales: Float[Array, "N 3"],
    viewmat: Float[Array, "4 4"],
    K: Float[Array, "3 3"],
    width: int,
    height: int,
) -> Projected:
    """Project Gaussians by a pinhole camera, to first order around their centres (EWA; 3DGS, arXiv 2308.04079).

    Gradients flow to means, quats, scales, viewmat and K, and are zero for Gaussians nearer than the near plane.

    Args:
        means: centres, world units.
        quats: rotations, wxyz, any norm.
        scales: standard deviations along the principal axes, world units.
        viewmat: world to camera, OpenCV axes.
        K: intrinsics, pixels; skew moves centres but does not shear the ellipses.
        width: pixels.
        height: pixels.
    """
    camera_means = means @ viewmat[:3, :3].T + viewmat[None, :3, 3]
    # A NaN depth counts as visible, so that it shows in the image instead of vanishing.
    visible = ~(camera_means[:, 2] <= NEAR)
    x, y, z = jnp.where(visible[:, None], camera_means, jnp.array([0, 0, 1], means.dtype)[None]).T
    normalised = jnp.stack([x / z, y / z], axis=-1)
    means2d = normalised @ K[:2, :2].T + K[None, :2, 2]

    focal, centre = jnp.diagonal(K)[:2], K[:2, 2]
    size = jnp.array([width, height], means.dtype)
    margin = FIELD_MARGIN * 0.5 * size / focal
    lowest, highest = -(centre / focal + margin), (size - centre) / focal + margin
    tx, ty = jnp.clip(normalised, lowest[None], highest[None]).T
    turned, deviations = rotations(quats), scales.T

    def half(focal, tangent, row):
        """A row of J W R S, whose product with its transpose is the covariance."""
        towards = [focal / z * (viewmat[row, axis] - tangent * viewmat[2, axis]) for axis in range(3)]
        return [deviations[j] * sum(towards[k] * turned[k, j] for k in range(3)) for j in range(3)]

    u, v = half(focal[0], tx, 0), half(focal[1], ty, 1)
    dot = lambda p, q: sum(a * b for a, b in zip(p, q, strict=True))
    xx, xy, yy = dot(u, u) + BLUR, dot(u, v), dot(v, v) + BLUR
    # Cauchy-Schwarz bounds the unblurred determinant by zero; the blur keeps this sum positive after rounding too.
    determinant = (xx - BLUR) * (yy - BLUR) - xy * xy
    determinant = jnp.maximum(determinant, 0) + BLUR * (xx + yy - BLUR)
    return Projected(
        means2d=means2d,
        covariances2d=jnp.stack([xx, xy, yy]).T,
        conics=(jnp.stack([yy, -xy, xx]) / determinant[None]).T,
        depths=z,
        visible=visible,
    )
