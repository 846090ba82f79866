"""Where things move in a video of known cameras: what optical flow sees against what a still scene allows.

Every frame is matched with others, earlier and later by several gaps, that see the scene from about the same place. A
still point has one depth that explains all of its matches; a moving one has none: not across the epipolar lines, nor
along them, because the views are many and the sparse points bound the depth. How exact matches are is measured: for
each pixel by whether flow there and back returns, and for each view by how well the still bulk of the scene fits.
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

GAPS = ((1, 1), (2, 3), (4, 6), (7, 12))  # instants between matched frames, from and to
ACCURACY = 0.2  # pixels: how exact matches are taken to be at first, and three times the least they can be
OUTLIER = 10.0  # standard deviations at which a match contradicts in full
STILL_MATCHES = 1.0  # perfect matches that every pixel is credited with: without any, nothing moves
CONTRADICTION = 0.3  # part of the matches that contradict where something moves
EDGE_RADIUS = 0.02  # of the guided filter, as part of the picture's diagonal
EDGE_CONTRAST = 0.1  # that makes an edge, as part of the grey scale
SMALLEST = 1e-3  # part of the picture that a moving or still region covers at least


def moving_masks(
    cameras: Camera, images: Float[np.ndarray, "F H W 3"], points: Float[np.ndarray, "P 3"]
) -> Iterator[tuple[int, Bool[np.ndarray, "H W"]]]:
    """Masks of what moves, one after the other in the order of time.

    Args:
        cameras: of the frames, in any order; several may be of one instant.
        images: sRGB values in [0, 1], dark and noisy as they may be.
        points: where the scene has surfaces, world units. Only their range of depths and how far they shift between
            views count, so some may move.

    Yields:
        The index of a frame, and its mask: True where something moves.

    Raises:
        UserError: all frames are of one instant.
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
    """Frames to match a frame with: for every gap in `GAPS`, earlier and later, the one whose view differs least.

    Views differ by how far points shift between them, in the median. A view of the same instant comes with them if
    there is one: it shows the depth, whatever moves.

    Args:
        cameras: of all frames.
        points: where the scene has surfaces, world units.
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
        return round(shift, 1), abs(int(offsets[other]))  # of equal views the one closer in time

    bands = [(0, 0), *GAPS, *((-last, -first) for first, last in GAPS)]
    candidates = [np.flatnonzero((first <= offsets) & (offsets <= last)) for first, last in bands]
    others = [band[band != frame].tolist() for band in candidates]
    return [min(band, key=difference) for band in others if band]


def inverse_depths(
    cameras: Camera, points: Float[np.ndarray, "P 3"], size: tuple[int, int], frame: int
) -> tuple[float, float]:
    """The least and the greatest inverse depth to think of, 1 / world units: half and twice those of visible points."""
    nearest, farthest = np.percentile(_visible(cameras, points, size, frame)[1], (1, 99))
    return 0.5 / float(farthest), 2 / float(nearest)


def contradiction(
    geometry: EpipolarGeometry, matches: Matches, depths: tuple[float, float]
) -> Float32[np.ndarray, "H W"]:
    """Which part of a pixel's matches contradicts that it shows a still point, at whatever depth suits it best.

    Residuals count by their squares, and in full from `OUTLIER` standard deviations of matches with that view, which
    are known from the median residual, most of the scene being still. A match counts less the further from its start
    flow returns.

    Args:
        geometry: from the frame to each of the K matched ones.
        matches: with them.
        depths: least and greatest inverse depth.

    Returns:
        Values in [0, 1].
    """
    height, width = matches.errors.shape[1:]
    pixels = pixel_indices(height, width) + np.float32(0.5)
    residuals = static_residuals(geometry, pixels, matches.positions, depths)
    returned = matches.errors < 1
    sigmas = np.full(len(residuals[0]), ACCURACY, np.float32)
    for _ in range(2):
        variances = sigmas[:, None, None] ** 2
        # Flow errs twice on its way there and back.
        weights = np.where(matches.errors < LOST, variances / (variances + matches.errors**2 / 2), 0)
        costs = np.minimum(residuals**2 / (variances * OUTLIER**2), 1)
        scores = (weights * costs).sum(1) / (weights.sum(0) + STILL_MATCHES)
        fitted = np.take_along_axis(residuals, scores.argmin(0)[None, None], axis=0)[0]
        medians = [np.median(r[b]) if b.any() else 0 for r, b in zip(fitted, returned, strict=True)]
        # Of a vector with normal components, one standard deviation each, the median length is 1.177.
        sigmas = np.maximum(np.array(medians, np.float32) / 1.177, ACCURACY / 3)
    return scores.min(0).astype(np.float32)


def segmented(score: Float32[np.ndarray, "H W"], grey: UInt8[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """The mask of a score in [0, 1], its outline drawn to the edges of the picture, without specks and pinholes."""
    radius = max(2, round(EDGE_RADIUS * float(np.hypot(*grey.shape))))
    guide = grey.astype(np.float32) / 255
    mask = cv2.ximgproc.guidedFilter(guide, score, radius, EDGE_CONTRAST**2) > CONTRADICTION
    smallest = max(1, round(SMALLEST * mask.size))
    return ~_without_specks(~_without_specks(mask, smallest), smallest)


def _without_specks(mask: Bool[np.ndarray, "H W"], smallest: int) -> Bool[np.ndarray, "H W"]:
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    large = statistics[:, cv2.CC_STAT_AREA] >= smallest
    large[0] = False  # what is not in the mask
    return large[labels]


def _visible(
    cameras: Camera, points: Float[np.ndarray, "P 3"], size: tuple[int, int], frame: int
) -> tuple[Float[np.ndarray, "V 2"], Float[np.ndarray, " V"]]:
    """Pixels and depths of the points within a frame's picture."""
    viewmat, K = (np.asarray(x[frame], np.float64) for x in (cameras.viewmat, cameras.K))
    return points_inside(points.astype(np.float64), viewmat, K, size)[1:]
