"""Projection of 3D Gaussians onto the image plane: elliptical weighted averaging (EWA)."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from l2dgs_jax.kernels.fusion import fusion_boundary

NEAR_PLANE = 0.01  # world units
EPS_2D = 0.3  # pixels^2
FIELD_MARGIN = 0.3  # of half the field of view: the Jacobian follows centres up to that far outside the image


Column = Float[Array, " N"]
Columns = tuple[Column, ...]


class Projected(NamedTuple):
    """Gaussians on the image plane.

    Attributes:
        means2d: centres in pixels.
        covariances2d: (xx, xy, yy) in pixels^2, including the blur `eps2d`.
        conics: (xx, xy, yy) of the inverse of the covariance, pixels^-2.
        depths: distance along the camera's z axis, world units.
        visible: whether the centre lies beyond the near plane; otherwise the other values are finite but meaningless.
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
    near_plane: Float[Array, ""] | float = NEAR_PLANE,
    eps2d: float = EPS_2D,
) -> Projected:
    """Project Gaussians with a pinhole camera, to first order around their centres (EWA; 3DGS, arXiv 2308.04079).

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
        near_plane: world units; Gaussians whose centre is nearer are not visible.
        eps2d: pixels^2, more than 0, added to the projected covariance, so that no Gaussian falls between pixels.
    """
    size = jnp.array([width, height], means.dtype)
    visible, depth, normalised = _before_camera(tuple(means.T), viewmat, jnp.asarray(near_plane, means.dtype))
    centre, jacobian = _through_lens(depth, normalised, viewmat, K, size)
    halves = _half(jacobian, _rotation(*_unit(*quats.T)), tuple(scales.T))
    *covariance, sharp = _bounded(_covariance, eps2d=eps2d)(*halves)
    conic = _bounded(_conic, eps2d=eps2d)(*covariance, sharp)
    return Projected(jnp.stack(centre).T, jnp.stack(covariance).T, jnp.stack(conic).T, depth, visible)


# Every entry of a point or a matrix is a column, one vector over all Gaussians, because CPUs are fast at arithmetic
# with whole columns. Columns are stored only between the functions below; within one, XLA recomputes them where needed.


@cache  # always the same function object for the same numbers, so that jax finds what it has compiled
def _bounded(function: Callable[..., Any], **numbers: float) -> Callable[..., Any]:
    return fusion_boundary(partial(function, **numbers))


@fusion_boundary
def _unit(w: Column, x: Column, y: Column, z: Column) -> Columns:
    squared = w * w + x * x + y * y + z * z
    zero = squared <= 1e-24
    inverse_norm = jnp.where(zero, 0, 1 / jnp.sqrt(jnp.where(zero, 1, squared)))
    return tuple(part * inverse_norm for part in (w, x, y, z))


@fusion_boundary
def _rotation(w: Column, x: Column, y: Column, z: Column) -> tuple[Columns, ...]:
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@fusion_boundary
def _before_camera(
    mean: Columns, viewmat: Float[Array, "4 4"], near_plane: Float[Array, ""]
) -> tuple[Bool[Array, " N"], Column, Columns]:
    """Whether a centre is visible, its depth, and where its ray meets the plane at depth 1."""
    x, y, z = (sum(viewmat[row, k] * mean[k] for k in range(3)) + viewmat[row, 3] for row in range(3))
    # A NaN depth counts as visible, so that it shows in the image instead of vanishing.
    visible = ~(z <= near_plane)
    z = jnp.where(visible, z, 1)
    return visible, z, tuple(jnp.where(visible, part, 0) / z for part in (x, y))


@fusion_boundary
def _through_lens(
    depth: Column, normalised: Columns, viewmat: Float[Array, "4 4"], K: Float[Array, "3 3"], size: Float[Array, "2"]
) -> tuple[Columns, tuple[Columns, ...]]:
    """The centre in pixels, and the rows of J W, clamped to the field of view."""

    def row(axis: int) -> Columns:
        focal, centre = K[axis, axis], K[axis, 2]
        margin = FIELD_MARGIN * 0.5 * size[axis] / focal
        tangent = jnp.clip(normalised[axis], -(centre / focal + margin), (size[axis] - centre) / focal + margin)
        return tuple(focal / depth * (viewmat[axis, k] - tangent * viewmat[2, k]) for k in range(3))

    def pixel(axis: int) -> Column:
        return K[axis, 0] * normalised[0] + K[axis, 1] * normalised[1] + K[axis, 2]

    return (pixel(0), pixel(1)), (row(0), row(1))


@fusion_boundary
def _half(jacobian: tuple[Columns, ...], rotation: tuple[Columns, ...], scale: Columns) -> tuple[Columns, ...]:
    """J W R S, whose product with its transpose is the covariance."""
    return tuple(tuple(scale[j] * sum(row[k] * rotation[k][j] for k in range(3)) for j in range(3)) for row in jacobian)


def _covariance(u: Columns, v: Columns, *, eps2d: float) -> Columns:
    """The covariance with blur, and its determinant without."""
    dot = lambda p, q: sum(a * b for a, b in zip(p, q, strict=True))
    cross = lambda j, k: u[j] * v[k] - u[k] * v[j]
    # By Lagrange's identity; xx yy - xy^2 would cancel if the Gaussian is long and thin.
    determinant = cross(0, 1) ** 2 + cross(1, 2) ** 2 + cross(2, 0) ** 2
    return dot(u, u) + eps2d, dot(u, v), dot(v, v) + eps2d, determinant


def _conic(xx: Column, xy: Column, yy: Column, sharp: Column, *, eps2d: float) -> Columns:
    """The inverse of a covariance with blur, whose determinant without is `sharp`."""
    determinant = sharp + eps2d * (xx + yy - eps2d)
    return yy / determinant, -xy / determinant, xx / determinant
