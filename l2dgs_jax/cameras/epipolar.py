"""Where points of a rigid scene may appear in another view, and how far matches are from there.

A point on the pixel p = (u, v, 1) of one view, at depth 1 / w, appears in another view at the direction H p + w e: as w
grows it runs from where the infinitely far would be along the epipolar line towards the epipole e (Hartley and
Zisserman, Multiple View Geometry, section 9).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from l2dgs_jax.types import Camera

_NEAREST = 1e-6  # of the depth in the first view: what is no deeper in the second is behind it


class EpipolarGeometry(NamedTuple):
    """From pixels of one view to pixels of another, or of K others.

    Attributes:
        H: the homography of the plane at infinity.
        e: the epipole times the distance, in homogeneous pixels.
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
) -> Float[np.ndarray, "*S 2"]:
    """Pixels of the second view that show what lies at `inverse_depth` on pixels of the first."""
    return _pixels(pixels @ geometry.H[:, :2].T + geometry.H[:, 2] + inverse_depth[..., None] * geometry.e)


def static_residuals(
    geometry: EpipolarGeometry,
    pixels: Float[np.ndarray, "*S 2"],
    matches: Float[np.ndarray, "K *S 2"],
    inverse_depths: tuple[float, float],
) -> Float[np.ndarray, "C K *S"]:
    """How far matches in K views are from where a still point would appear, for C guesses of its depth.

    Each match proposes the depth, within the given range, that places the point nearest to itself on its epipolar line;
    so does the median of these. For two views the residual of the match's own guess is the epipolar distance if the
    epipolar lines are parallel, or if it is zero; and it is more if the point would lie behind or too far.

    Args:
        geometry: from the first view to each of K others.
        pixels: of the first view.
        matches: of the same points in the other views.
        inverse_depths: the least and the greatest to think of, in the first view, 1 / world units.

    Returns:
        Pixels, for C = K + 1 guesses in each of K views.
    """
    far, a, b = depth_equations(geometry, pixels, matches)
    proposals = np.clip(proposed(a, b), *inverse_depths)
    proposals = np.concatenate([proposals, np.median(proposals, axis=0, keepdims=True)]).astype(matches.dtype)
    return np.stack([epipolar_residuals(geometry, far, matches, w) for w in proposals])


class DepthEquations(NamedTuple):
    """Of every match, two equations a + w b = 0 of the inverse depth w: far + w e is parallel to (match, 1).

    Attributes:
        far: directions in which the infinitely far would be seen.
        a: see above.
        b: likewise.
    """

    far: Float[np.ndarray, "K *S 3"]
    a: Float[np.ndarray, "K *S 2"]
    b: Float[np.ndarray, "K *S 2"]


def depth_equations(
    geometry: EpipolarGeometry, pixels: Float[np.ndarray, "*S 2"], matches: Float[np.ndarray, "K *S 2"]
) -> DepthEquations:
    """What matches of pixels with K other views say of their inverse depth, in the type of the matches."""
    kind = matches.dtype
    e = geometry.e.astype(kind)[_over(pixels)]
    far = np.stack([pixels @ H[:, :2].T + H[:, 2] for H in geometry.H.astype(kind)])
    return DepthEquations(far, far[..., :2] - matches * far[..., 2:], e[..., :2] - matches * e[..., 2:])


def proposed(a: Float[np.ndarray, "*S 2"], b: Float[np.ndarray, "*S 2"]) -> Float[np.ndarray, "*S"]:
    """The inverse depths that solve the `DepthEquations` best, each match's for itself."""
    return -(a * b).sum(-1) / np.maximum((b * b).sum(-1), np.finfo(b.dtype).tiny)


def epipolar_residuals(
    geometry: EpipolarGeometry,
    far: Float[np.ndarray, "K *S 3"],
    matches: Float[np.ndarray, "K *S 2"],
    inverse_depth: Float[np.ndarray, "*S"],
) -> Float[np.ndarray, " K *S"]:
    """Pixels between matches and where they would be at that inverse depth; `far` is of their `DepthEquations`."""
    e = geometry.e.astype(matches.dtype)[_over(inverse_depth[..., None])]
    return np.linalg.norm(_pixels(far + inverse_depth[..., None] * e) - matches, axis=-1)


def _over(pixels: Float[np.ndarray, "*S 2"] | Float[np.ndarray, "*S 1"]) -> tuple:
    """The index that lets one row for each of K views meet all pixels."""
    return slice(None), *(None,) * (pixels.ndim - 1)


def _pixels(directions: Float[np.ndarray, "*S 3"]) -> Float[np.ndarray, "*S 2"]:
    return directions[..., :2] / np.maximum(directions[..., 2:], directions.dtype.type(_NEAREST))
