"""Epipolar geometry: where static points can appear in another view, and how far matches lie from there.

A point seen at the pixel p = (u, v, 1) of one view, at inverse depth w, appears in another view at H p + w e in
homogeneous pixels: as w grows it moves along the epipolar line, from the image of the point at infinity towards the
epipole e (Hartley and Zisserman, Multiple View Geometry, section 9).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from l2dgs_jax.types import Camera

# Lower bound on a point's depth in the second view over that in the first: points behind the camera end up far away.
_MIN_DEPTH_RATIO = 1e-6


class EpipolarGeometry(NamedTuple):
    """From pixels of one view to pixels of another, or of K others.

    Attributes:
        H: the homography of the plane at infinity.
        e: the epipole in homogeneous pixels, scaled by the baseline.
    """

    H: Float[np.ndarray, "*K 3 3"]
    e: Float[np.ndarray, "*K 3"]


def epipolar_geometry(cameras: Camera, first: int, second: int | Sequence[int]) -> EpipolarGeometry:
    """The geometry from the view `first` to the view or views `second` of a batch of cameras."""
    to_second = np.asarray(cameras.viewmat[second], np.float64) @ np.linalg.inv(
        np.asarray(cameras.viewmat[first], np.float64)
    )
    K_first, K_second = (np.asarray(cameras.K[index], np.float64) for index in (first, second))
    H = K_second @ to_second[..., :3, :3] @ np.linalg.inv(K_first)
    return EpipolarGeometry(H, (K_second @ to_second[..., :3, 3:])[..., 0])


def project(
    geometry: EpipolarGeometry, pixels: Float[np.ndarray, "*S 2"], inverse_depth: Float[np.ndarray, "*S"]
) -> Float[np.ndarray, "... 2"]:
    """Pixels of the second view, or of K others, that show what pixels of the first see at `inverse_depth`.

    For K others, pixels must be [N 2].
    """
    H, e = geometry.H, geometry.e[..., None, :]
    return _dehomogenised(pixels @ H[..., :2].swapaxes(-1, -2) + H[..., None, :, 2] + inverse_depth[..., None] * e)


def static_residuals(
    geometry: EpipolarGeometry,
    pixels: Float[np.ndarray, "*S 2"],
    matches: Float[np.ndarray, "K *S 2"],
    inverse_depths: tuple[float, float],
) -> Float[np.ndarray, "C K *S"]:
    """Distance of matches in K views from where a static point would appear, for C candidates of its depth.

    Each match proposes the inverse depth that fits it best, clipped to the given range; the median of these is one more
    candidate. The residual of a match at its own proposal is its epipolar distance if that is zero or the epipolar
    lines are parallel, and larger if the proposal was clipped: the point would lie behind the camera or out of range.

    Args:
        geometry: from the first view to each of K others.
        pixels: of the first view.
        matches: of the same points in the other views.
        inverse_depths: the least and the greatest to consider, in the first view, 1 / world units.

    Returns:
        Residuals in pixels, of C = K + 1 candidates in each of K views.
    """
    far, a, b = depth_equations(geometry, pixels, matches)
    proposals = np.clip(proposed(a, b), *inverse_depths)
    proposals = np.concatenate([proposals, np.median(proposals, axis=0, keepdims=True)]).astype(matches.dtype)
    return np.stack([epipolar_residuals(geometry, far, matches, w) for w in proposals])


class DepthEquations(NamedTuple):
    """Two equations a + w b = 0 in the inverse depth w for every match: far + w e is to be parallel to (match, 1).

    Attributes:
        far: H p, where the point at infinity appears, homogeneous pixels.
        a: constant terms.
        b: coefficients of w.
    """

    far: Float[np.ndarray, "K *S 3"]
    a: Float[np.ndarray, "K *S 2"]
    b: Float[np.ndarray, "K *S 2"]


def depth_equations(
    geometry: EpipolarGeometry, pixels: Float[np.ndarray, "*S 2"], matches: Float[np.ndarray, "K *S 2"]
) -> DepthEquations:
    """What matches of pixels in K other views say about their inverse depth, in the type of the matches."""
    dtype = matches.dtype
    e = geometry.e.astype(dtype)[_per_view(pixels)]
    far = np.stack([pixels @ H[:, :2].T + H[:, 2] for H in geometry.H.astype(dtype)])
    return DepthEquations(far, far[..., :2] - matches * far[..., 2:], e[..., :2] - matches * e[..., 2:])


def proposed(a: Float[np.ndarray, "*S 2"], b: Float[np.ndarray, "*S 2"]) -> Float[np.ndarray, "*S"]:
    """The least-squares inverse depth of every match by itself, from its `DepthEquations`."""
    return -(a * b).sum(-1) / np.maximum((b * b).sum(-1), np.finfo(b.dtype).tiny)


def epipolar_residuals(
    geometry: EpipolarGeometry,
    far: Float[np.ndarray, "K *S 3"],
    matches: Float[np.ndarray, "K *S 2"],
    inverse_depth: Float[np.ndarray, "*S"],
) -> Float[np.ndarray, " K *S"]:
    """Reprojection errors in pixels of matches at that inverse depth; `far` is that of their `DepthEquations`."""
    e = geometry.e.astype(matches.dtype)[_per_view(inverse_depth[..., None])]
    return np.linalg.norm(_dehomogenised(far + inverse_depth[..., None] * e) - matches, axis=-1)


def _per_view(pixels: Float[np.ndarray, "*S 2"] | Float[np.ndarray, "*S 1"]) -> tuple:
    """The index that makes an array of one row per view broadcast over all pixels."""
    return slice(None), *(None,) * (pixels.ndim - 1)


def _dehomogenised(directions: Float[np.ndarray, "*S 3"]) -> Float[np.ndarray, "*S 2"]:
    return directions[..., :2] / np.maximum(directions[..., 2:], directions.dtype.type(_MIN_DEPTH_RATIO))
