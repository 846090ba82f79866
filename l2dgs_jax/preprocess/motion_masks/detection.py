"""Detecting motion in a video with known camera poses: optical flow compared with what a static scene allows.

Every frame is matched with earlier and later ones, at several gaps, that show the scene from similar viewpoints. For a
static point, one depth explains all of its matches; for a moving one, none does: neither across the epipolar lines nor,
because the views are many and the sparse points bound the depth, along them. The accuracy of matches is measured: for
each pixel by whether forward and backward flow agree, and for each view by how well the mostly static scene fits.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from l2dgs_jax.cameras.epipolar import EpipolarGeometry, epipolar_geometry, project, static_residuals
from l2dgs_jax.cameras.flow import LOST, Matches, brightened, matcher, pixel_indices
from l2dgs_jax.cameras.geometry import points_inside
from l2dgs_jax.errors import UserError
from l2dgs_jax.types import Camera

GAPS = ((1, 1), (2, 3), (4, 6), (7, 12))  # ranges of instants between matched frames, first and last
MATCH_SIGMA = 0.2  # standard deviation of matches in pixels: the first estimate; later ones are at least a third of it
OUTLIER = 10.0  # standard deviations from which on a match counts fully against a static point
STATIC_PRIOR = 1.0  # number of perfect static matches added for every pixel, so that without matches nothing moves
MOVING_ABOVE = 0.3  # share of the matches that contradict a static point from which on a pixel counts as moving
EDGE_RADIUS = 0.02  # of the guided filter, relative to the picture's diagonal
EDGE_CONTRAST = 0.1  # that counts as an edge, relative to the range of grey values
SMALLEST_REGION = 1e-3  # moving or static, as a share of the picture; smaller ones are removed


def moving_masks(
    cameras: Camera, images: Float[np.ndarray, "F H W 3"], points: Float[np.ndarray, "P 3"]
) -> Iterator[tuple[int, Bool[np.ndarray, "H W"]]]:
    """Masks of what moves, one by one in the order of time.

    Args:
        cameras: of the frames, in any order; several may have the same instant.
        images: sRGB values in [0, 1]; they may be dark and noisy.
        points: on surfaces of the scene, world units. Only their range of depths and their shift between views are
            used, so some of them may move.

    Yields:
        The index of a frame, and its mask: True where something moves.

    Raises:
        UserError: all frames have the same instant.
    """
    if len(np.unique(cameras.time)) < 2:
        raise UserError("all frames are of one instant; expected frames of at least two, to see motion between them")
    greys = brightened(images)
    matches = matcher(greys)
    height, width = greys.shape[1:]
    for frame in np.argsort(cameras.time, kind="stable").tolist():
        others = partners(cameras, points, (width, height), frame)
        if others:
            geometry = epipolar_geometry(cameras, frame, others)
            depths = inverse_depths(cameras, points, (width, height), frame)
            score = contradiction(geometry, matches(frame, others), depths)
            yield frame, segmented(score, greys[frame])
        else:
            yield frame, np.zeros((height, width), bool)


def partners(cameras: Camera, points: Float[np.ndarray, "P 3"], size: tuple[int, int], frame: int) -> list[int]:
    """Frames to match a frame with: for every gap in `GAPS`, earlier and later, the one with the most similar view.

    The difference of views is the median shift of points between them. If there is another view of the same instant, it
    is included: it shows the depth even of what moves.

    Args:
        cameras: of all frames.
        points: on surfaces of the scene, world units.
        size: width and height of the pictures.
        frame: index of the frame.
    """
    seen, depth = _visible(cameras, points, size, frame)
    instants = np.unique(cameras.time, return_inverse=True)[1].reshape(-1)
    offsets = instants - instants[frame]
    if not len(depth):
        return []

    def difference(other: int) -> tuple[float, int]:
        ends = project(epipolar_geometry(cameras, frame, other), seen, 1 / depth)
        shift = float(np.median(np.linalg.norm(ends - seen, axis=-1)))
        return round(shift, 1), abs(int(offsets[other]))  # of similar views, the one closer in time

    bands = [(0, 0), *GAPS, *((-last, -first) for first, last in GAPS)]
    candidates = [np.flatnonzero((first <= offsets) & (offsets <= last)) for first, last in bands]
    others = [band[band != frame].tolist() for band in candidates]
    return [min(band, key=difference) for band in others if band]


def inverse_depths(
    cameras: Camera, points: Float[np.ndarray, "P 3"], size: tuple[int, int], frame: int
) -> tuple[float, float]:
    """Least and greatest inverse depth to consider, 1 / world units: half and twice those of visible points."""
    nearest, farthest = np.percentile(_visible(cameras, points, size, frame)[1], (1, 99))
    return 0.5 / float(farthest), 2 / float(nearest)


def contradiction(
    geometry: EpipolarGeometry, matches: Matches, depths: tuple[float, float]
) -> Float32[np.ndarray, "H W"]:
    """Share of a pixel's matches that contradict a static point, at the depth that suits the pixel best.

    Squared residuals are added up, limited at `OUTLIER` standard deviations of the matches with that view. These are
    estimated from the median residual, because most of the scene is static. The weight of a match falls with the
    distance from its start at which forward and backward flow end.

    Args:
        geometry: from the frame to each of the K matched ones.
        matches: of the frame with these.
        depths: least and greatest inverse depth.

    Returns:
        Values in [0, 1].
    """
    height, width = matches.errors.shape[1:]
    pixels = pixel_indices(height, width) + np.float32(0.5)
    residuals = static_residuals(geometry, pixels, matches.positions, depths)
    returned = matches.errors < 1
    sigmas = np.full(len(residuals[0]), MATCH_SIGMA, np.float32)
    for _ in range(2):
        variances = sigmas[:, None, None] ** 2
        # The round trip contains the errors of two flows, hence the factor of 1/2.
        weights = np.where(matches.errors < LOST, variances / (variances + matches.errors**2 / 2), 0)
        costs = np.minimum(residuals**2 / (variances * OUTLIER**2), 1)
        scores = (weights * costs).sum(1) / (weights.sum(0) + STATIC_PRIOR)
        fitted = np.take_along_axis(residuals, scores.argmin(0)[None, None], axis=0)[0]
        medians = [np.median(r[b]) if b.any() else 0 for r, b in zip(fitted, returned, strict=True)]
        # The median length of a 2D normal vector is 1.177 standard deviations of a component.
        sigmas = np.maximum(np.array(medians, np.float32) / 1.177, MATCH_SIGMA / 3)
    return scores.min(0).astype(np.float32)


def segmented(score: Float32[np.ndarray, "H W"], grey: UInt8[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """The mask of a score in [0, 1], with outlines aligned to the picture's edges and without specks and holes."""
    radius = max(2, round(EDGE_RADIUS * float(np.hypot(*grey.shape))))
    guide = grey.astype(np.float32) / 255
    mask = cv2.ximgproc.guidedFilter(guide, score, radius, EDGE_CONTRAST**2) > MOVING_ABOVE
    smallest = max(1, round(SMALLEST_REGION * mask.size))
    return ~_without_specks(~_without_specks(mask, smallest), smallest)


def _without_specks(mask: Bool[np.ndarray, "H W"], smallest: int) -> Bool[np.ndarray, "H W"]:
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    large = statistics[:, cv2.CC_STAT_AREA] >= smallest
    large[0] = False  # the label of everything outside the mask
    return large[labels]


def _visible(
    cameras: Camera, points: Float[np.ndarray, "P 3"], size: tuple[int, int], frame: int
) -> tuple[Float[np.ndarray, "V 2"], Float[np.ndarray, " V"]]:
    """Pixels and depths of the points that lie inside a frame's picture."""
    viewmat, K = (np.asarray(x[frame], np.float64) for x in (cameras.viewmat, cameras.K))
    return points_inside(points.astype(np.float64), viewmat, K, size)[1:]
