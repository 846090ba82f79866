"""Projection of 3D Gaussians onto the image plane: elliptical weighted averaging (EWA)."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from l2dgs_jax.native import stage

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
    """Rotation matrices of quaternions (wxyz) of any norm; a zero quaternion is the identity and has no gradient."""
    return jnp.stack([jnp.stack(row) for row in _rotation(*_unit(*quats.T))])


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

    Gradients flow to means, quats, scales, viewmat and K, in reverse mode only, and are zero for Gaussians nearer than
    the near plane.

    Args:
        means: centres, world units.
        quats: rotations, wxyz, any norm.
        scales: standard deviations along the principal axes, world units.
        viewmat: world to camera, OpenCV axes.
        K: intrinsics, pixels; skew moves centres but does not shear the ellipses.
        width: pixels.
        height: pixels.
    """
    size = jnp.array([width, height], means.dtype)
    visible, depth, normalised = _before_camera(tuple(means.T), viewmat)
    centre, jacobian = _through_lens(depth, normalised, viewmat, K, size)
    covariance = _covariance(*_half(jacobian, _rotation(*_unit(*quats.T)), tuple(scales.T)))
    gather = lambda columns: jnp.stack(columns).T
    return Projected(gather(centre), gather(covariance), gather(_conic(*covariance)), depth, visible)


# Every entry of a point or a matrix is a column, one vector over all Gaussians: arithmetic with whole columns is what
# CPUs are fast at. Columns are kept between the stages; within one they are computed again for each that needs them.


@stage
def _unit(w, x, y, z):
    squared = w * w + x * x + y * y + z * z
    zero = squared <= 1e-24
    inverse_norm = jnp.where(zero, 0, 1 / jnp.sqrt(jnp.where(zero, 1, squared)))
    return tuple(part * inverse_norm for part in (w, x, y, z))


@stage
def _rotation(w, x, y, z):
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@stage
def _before_camera(mean, viewmat):
    """Whether a centre is visible, its depth, and where its ray meets the plane at depth 1."""
    x, y, z = (sum(viewmat[row, k] * mean[k] for k in range(3)) + viewmat[row, 3] for row in range(3))
    # A NaN depth counts as visible, so that it shows in the image instead of vanishing.
    visible = ~(z <= NEAR)
    z = jnp.where(visible, z, 1)
    return visible, z, tuple(jnp.where(visible, part, 0) / z for part in (x, y))


@stage
def _through_lens(depth, normalised, viewmat, K, size):
    """The centre in pixels, and the rows of J W, clamped to the field of view."""

    def row(axis):
        focal, centre = K[axis, axis], K[axis, 2]
        margin = FIELD_MARGIN * 0.5 * size[axis] / focal
        tangent = jnp.clip(normalised[axis], -(centre / focal + margin), (size[axis] - centre) / focal + margin)
        return tuple(focal / depth * (viewmat[axis, k] - tangent * viewmat[2, k]) for k in range(3))

    pixel = lambda axis: K[axis, 0] * normalised[0] + K[axis, 1] * normalised[1] + K[axis, 2]
    return (pixel(0), pixel(1)), (row(0), row(1))


@stage
def _half(jacobian, rotation, scale):
    """J W R S, whose product with its transpose is the covariance."""
    return tuple(tuple(scale[j] * sum(row[k] * rotation[k][j] for k in range(3)) for j in range(3)) for row in jacobian)


@stage
def _covariance(u, v):
    dot = lambda p, q: sum(a * b for a, b in zip(p, q, strict=True))
    return dot(u, u) + BLUR, dot(u, v), dot(v, v) + BLUR


@stage
def _conic(xx, xy, yy):
    # Cauchy-Schwarz bounds the unblurred determinant by zero; the blur keeps this sum positive after rounding too.
    determinant = (xx - BLUR) * (yy - BLUR) - xy * xy
    determinant = jnp.maximum(determinant, 0) + BLUR * (xx + yy - BLUR)
    return yy / determinant, -xy / determinant, xx / determinant
