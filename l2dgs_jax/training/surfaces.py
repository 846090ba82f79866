"""Initial points on static surfaces, triangulated from optical flow where structure from motion found few.

In the dark it finds few, and Gaussians that grow from these would have to cover all surfaces in between in a short
training. As the cameras are known, optical flow tells the depth of almost every pixel, so that Gaussians can start on
all that the frames show (as in EDGS, arXiv 2504.13204, whose matches come from a network).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.spatial import cKDTree

from l2dgs_jax.cameras.epipolar import (
    EpipolarGeometry,
    depth_equations,
    epipolar_geometry,
    epipolar_residuals,
    project,
    proposed,
)
from l2dgs_jax.cameras.flow import brightened, matcher, pixel_indices, surely_valid
from l2dgs_jax.cameras.geometry import camera_centres, pixel_rays, points_inside
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.stacks import evenly_spread
from l2dgs_jax.model.initialisation import spread_over
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera

MAX_FRAMES = 100  # frames whose depth maps are computed
MAX_POINTS = 1000  # points by which parallax is measured
PARALLAXES = (2, 5, 10, 20)  # pixels; for each, the nearest frame on either side with so much parallax is matched
MAX_SHIFT = 0.15  # median displacement of points between matched frames, over the width: beyond it flow fails
MAX_FORWARD_BACKWARD_ERROR = 1.0  # pixels; matches of a larger error are not trusted
INLIER_THRESHOLD = 1.0  # pixels of reprojection error below which a match supports a depth
OUTLIER_THRESHOLD = 2.0  # pixels of reprojection error above which a match contradicts a depth
MAX_OUTLIERS = 0.34  # share of the trusted matches that may contradict a depth
REFITS = 3  # least-squares fits of a depth to its inliers, which change with it
MATCH_SIGMA = 0.3  # standard deviation of a match in pixels
MAX_RELATIVE_ERROR = 0.05  # standard deviation of an inverse depth that is kept, over the inverse depth
INVERSE_DEPTH_RANGE = 0.3, 2.0  # factors on the points' least and greatest inverse depth that bound the search
SPACING = 2  # pixels between added points, at least
COVERED_TOLERANCE = 0.1  # relative difference of depths up to which a point already covers a pixel
MIN_AGREEING = 3  # frames whose depth maps must agree with an added point, the one it comes from included
AGREEMENT_TOLERANCE = 0.05  # relative difference of depths up to which a frame agrees with a point
SEEN_THROUGH_TOLERANCE = 0.1  # relative difference of depths from which a frame sees past a point to what is behind
MAX_SEEN_THROUGH = 0.25  # frames that see past a point, over those that agree with it
AROUND = 8  # points whose median a point is moved to


class DepthMap(NamedTuple):
    """Depths that one frame shows.

    Attributes:
        viewmat: of the frame's camera, world to camera.
        K: of the frame's camera, pixels.
        inverse: inverse depth, 1 / world units; NaN where it is not known.
    """

    viewmat: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    inverse: Float32[np.ndarray, "H W"]


def find_surfaces(
    points: Float[np.ndarray, "P 3"], split: Split, most: int, *, random: bool = False
) -> Float32[np.ndarray, "N 3"]:
    """Points on static surfaces that the frames show and `points` do not cover; none where no flow can be trusted.

    Args:
        points: of the scene, world units.
        split: the frames.
        most: how many may be added; those that most frames agree on come first.
        random: whether the points are, so that they cover nothing.
    """
    if not most:
        return np.zeros((0, 3), np.float32)
    return fused(points[:0] if random else points, depth_maps(points, split), most)


def thinned(points: Float[np.ndarray, "P 3"], most: int) -> Float[np.ndarray, "N 3"]:
    """At most so many points, as densely where they are dense, each at the median of those around it."""
    kept = points[spread_over(points, most)]
    _, around = cKDTree(points).query(kept, k=range(1, min(AROUND, len(points)) + 1))
    return np.median(points[around], axis=1)


def depth_maps(points: Float[np.ndarray, "P 3"], split: Split) -> list[DepthMap]:
    """Depth maps of the static scene, from flow between each of at most `MAX_FRAMES` frames and others with parallax.

    Args:
        points: of the scene, world units, from which parallax and the range of depths are estimated.
        split: the frames.
    """
    cameras, greys = split.cameras, brightened(split.images)
    height, width = greys.shape[1:]
    some = points[:: -(-len(points) // MAX_POINTS)].astype(np.float64)
    matches = matcher(greys)

    def depths_of(frame: int) -> DepthMap:
        viewmat, K = (np.asarray(x[frame], np.float64) for x in (cameras.viewmat, cameras.K))
        _, seen, depth = points_inside(some, viewmat, K, (width, height))
        others = _frames_to_match(cameras, seen, depth, frame, MAX_SHIFT * width)
        if not others:
            return DepthMap(viewmat, K, np.full((height, width), np.nan, np.float32))
        ends, errors = matches(frame, others)
        nearest, farthest = np.quantile(depth, (0.01, 0.99))
        geometry = epipolar_geometry(cameras, frame, others)
        bounds = INVERSE_DEPTH_RANGE[0] / farthest, INVERSE_DEPTH_RANGE[1] / nearest
        inverse = triangulated(geometry, ends, errors < MAX_FORWARD_BACKWARD_ERROR, bounds)
        if split.valid is not None:
            inverse[~surely_valid(split.valid[frame])] = np.nan
        return DepthMap(viewmat, K, inverse)

    frames = evenly_spread(len(greys), MAX_FRAMES)
    in_time = frames[np.argsort(cameras.time[frames], kind="stable")]  # so that cached flow is used again
    return [*prefetch(depths_of, in_time.tolist())]


def triangulated(
    geometry: EpipolarGeometry,
    matches: Float32[np.ndarray, "K H W 2"],
    trusted: Bool[np.ndarray, "K H W"],
    bounds: tuple[float, float],
) -> Float32[np.ndarray, "H W"]:
    """Inverse depths on which a view's matches in K others agree, 1 / world units; NaN where they do not.

    Every trusted match of a pixel proposes one. That with the most support among the matches is refitted to its inliers
    by least squares. It is kept if it has two inliers or more, few outliers and a small standard deviation, and lies
    inside the bounds.

    Args:
        geometry: from the view to each of the others.
        matches: of the view's pixels in the others.
        trusted: which of these count.
        bounds: least and greatest inverse depth to consider.
    """
    pixels = pixel_indices(*matches.shape[1:3]) + np.float32(0.5)
    far, a, b = depth_equations(geometry, pixels, matches)

    def support(inverse: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        residuals = epipolar_residuals(geometry, far, matches, inverse) / np.float32(INLIER_THRESHOLD)
        return (np.maximum(1 - residuals**2, 0) * trusted).sum(0)

    proposals = np.clip(proposed(a, b), *bounds).astype(np.float32)
    supports = np.where(trusted, np.stack([support(inverse) for inverse in proposals]), -1)
    best = np.take_along_axis(proposals, supports.argmax(0)[None], axis=0)[0]
    for _ in range(REFITS):
        inliers = trusted & (epipolar_residuals(geometry, far, matches, best) < INLIER_THRESHOLD)
        # A residual a + w b is the reprojection error in pixels times the homogeneous coordinate, which is divided out.
        weights = inliers / np.maximum(far[..., 2] + best * geometry.e[:, 2, None, None].astype(np.float32), 1e-6) ** 2
        information = (weights * (b * b).sum(-1)).sum(0)
        fitted = -(weights * (a * b).sum(-1)).sum(0) / np.maximum(information, np.finfo(np.float32).tiny)
        best = np.where(information > 0, np.clip(fitted, *bounds), best).astype(np.float32)
    residuals = epipolar_residuals(geometry, far, matches, best)
    outliers = (trusted & (residuals > OUTLIER_THRESHOLD)).sum(0)
    known = (trusted & (residuals < INLIER_THRESHOLD)).sum(0) >= 2
    known &= outliers <= MAX_OUTLIERS * trusted.sum(0)
    known &= MAX_RELATIVE_ERROR * best * np.sqrt(information) > MATCH_SIGMA
    known &= (best > bounds[0]) & (best < bounds[1])
    return np.where(known, best, np.float32(np.nan))


def fused(points: Float[np.ndarray, "P 3"], maps: Sequence[DepthMap], most: int) -> Float32[np.ndarray, "N 3"]:
    """Points of depth maps on which several of them agree, where none of `points` is.

    Args:
        points: of the scene, world units.
        maps: of its frames.
        most: how many may be added.
    """
    merged = np.asarray(points, np.float64)
    for index in np.random.default_rng(0).permutation(len(maps)):  # consecutive frames show nearly the same
        spacing = max(SPACING, round((maps[index].inverse.size / most) ** 0.5))
        merged = np.concatenate([merged, _uncovered(merged, maps[index], spacing)])
    added = merged[len(points) :]
    agreeing, seen_through = np.zeros((2, len(added)), int)
    for depths in maps:
        ratio = _depth_ratios(added, depths)  # NaN compares as False
        agreeing += np.abs(ratio - 1) < AGREEMENT_TOLERANCE
        seen_through += ratio < 1 - SEEN_THROUGH_TOLERANCE
    kept = np.flatnonzero((agreeing >= MIN_AGREEING) & (seen_through <= MAX_SEEN_THROUGH * agreeing))
    return added[kept[np.argsort(-agreeing[kept], kind="stable")[:most]]].astype(np.float32)


def _frames_to_match(
    cameras: Camera,
    seen: Float[np.ndarray, "S 2"],
    depth: Float[np.ndarray, " S"],
    frame: int,
    max_shift: float,
) -> list[int]:
    """Frames to match a frame with: for each of `PARALLAXES`, the nearest in time on either side that shows it.

    Other views of the same instant count for both sides.

    Args:
        cameras: of all frames.
        seen: pixels of points in the frame.
        depth: depths of these points, world units.
        frame: index of the frame.
        max_shift: pixels by which the points may be displaced between the frames, in the median.
    """
    if not len(seen):
        return []
    instants = np.unique(cameras.time, return_inverse=True)[1].reshape(-1)
    offsets = instants - instants[frame]
    geometry = epipolar_geometry(cameras, frame, range(len(instants)))
    ends, at_infinity = project(geometry, seen, 1 / depth), project(geometry, seen, 0 * depth)
    shifts = np.median(np.linalg.norm(ends - seen, axis=-1), axis=-1)
    parallaxes = np.median(np.linalg.norm(ends - at_infinity, axis=-1), axis=-1)
    chosen: set[int] = set()
    for side in (offsets <= 0, offsets >= 0):
        usable = np.flatnonzero(side & (shifts < max_shift))
        nearest = usable[np.argsort(np.abs(offsets[usable]), kind="stable")]
        enough = parallaxes[nearest] >= np.array(PARALLAXES)[:, None]
        chosen.update(nearest[enough.argmax(-1)[enough.any(-1)]].tolist() if len(nearest) else ())
    return sorted(chosen)


def _uncovered(points: Float[np.ndarray, "P 3"], depths: DepthMap, spacing: int) -> Float[np.ndarray, "N 3"]:
    """Points of a depth map, one per square of `spacing` pixels, in squares whose surface none of `points` covers."""
    viewmat, K, inverse = depths
    height, width = inverse.shape
    rows, columns = (np.arange(0, size, spacing) for size in (height, width))
    centres = np.minimum(rows + spacing // 2, height - 1)[:, None], np.minimum(columns + spacing // 2, width - 1)
    free = inverse[centres].astype(np.float64)
    _, (column, row), depth = _projected(points, depths)
    covers = np.abs(depth * free[row // spacing, column // spacing] - 1) < COVERED_TOLERANCE
    free[row[covers] // spacing, column[covers] // spacing] = np.nan

    row, column = (np.broadcast_to(centre, free.shape)[np.isfinite(free)] for centre in centres)
    pixels = np.stack([column + 0.5, row + 0.5], axis=-1)
    return camera_centres(viewmat) + pixel_rays(pixels, viewmat, K) / free[np.isfinite(free)][:, None]


def _depth_ratios(points: Float[np.ndarray, "P 3"], depths: DepthMap) -> Float[np.ndarray, " P"]:
    """Depths of points over the depth map's at their pixels; NaN where that is unknown or the point out of view."""
    ratio = np.full(len(points), np.nan)
    inside, (column, row), depth = _projected(points, depths)
    ratio[inside] = depth * depths.inverse[row, column]
    return ratio


def _projected(
    points: Float[np.ndarray, "P 3"], depths: DepthMap
) -> tuple[Bool[np.ndarray, " P"], Int[np.ndarray, "2 S"], Float[np.ndarray, " S"]]:
    """Which points project into a depth map (occlusion ignored), and the columns and rows and the depths of those."""
    inside, pixels, depth = points_inside(points, depths.viewmat, depths.K, depths.inverse.shape[::-1])
    return inside, pixels.astype(int).T, depth
