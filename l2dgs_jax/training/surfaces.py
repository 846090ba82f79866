"""Points to begin with on what stands still, where structure from motion found few.

In the dark it finds few, and what lies between them must then be covered by Gaussians that grow from there in a short
training. Where cameras are known, optical flow tells how far away almost every pixel is; Gaussians can start on all
that the frames show (as in EDGS, arXiv 2504.13204, whose matches come from a network).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from l2dgs_jax.cameras.epipolar import (
    EpipolarGeometry,
    depth_equations,
    epipolar_geometry,
    epipolar_residuals,
    project,
    proposed,
)
from l2dgs_jax.cameras.flow import brightened, matcher, pixel_indices
from l2dgs_jax.cameras.geometry import camera_centres, points_inside
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera

FRAMES = 100  # whose depth is looked for, at most
LOOKED_AT = 1000  # points that tell how far views are apart, at most
GAP = 10  # instants between matched frames, at most
PARALLAXES = (2, 5, 10, 20)  # pixels by which the nearest views on either side that are to be matched see depth
FARTHEST = 0.15  # of the width, by which views may differ: beyond it flow is lost
RETURNED = 1.0  # pixels from its start within which flow there and back must end to be trusted
AGREED = 1.0  # pixels from where a depth places a pixel up to which a match speaks for it
DISAGREED = 2.0  # likewise, from which it speaks against it
AGAINST = 0.34  # part of the matches that may
ROUNDS = 3  # of depth from the matches that agree, and these from depth
ACCURACY = 0.3  # standard deviation of a match in pixels
EXACT = 0.05  # relative error of a depth that is still of use
DEPTHS = 0.3, 2.0  # of inverse depths, factors on the least and the greatest that the points have
SPACING = 2  # pixels between points
SAME = 0.1  # relative difference of depths up to which a point is there already
SEEN_IN = 3  # frames whose own depths agree with a point
ALIKE = 0.05  # relative difference up to which they do
PAST = 0.1  # relative difference from which a frame sees through the point
SEEN_THROUGH = 0.25  # of the frames that agree, how many may


class DepthMap(NamedTuple):
    """What one frame tells.

    Attributes:
        viewmat: of its camera, as K.
        K: pixels.
        inverse: inverse depth, 1 / world units; NaN where it is not known.
    """

    viewmat: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    inverse: Float32[np.ndarray, "H W"]


def find_surfaces(points: Float[np.ndarray, "P 3"], split: Split, most: int) -> Float32[np.ndarray, "N 3"]:
    """Points where frames show something that stands still and no point is; none where flow cannot tell.

    Args:
        points: of the scene, world units.
        split: the frames.
        most: how many may be added; those that most frames agree on come first.
    """
    return fused(points, depth_maps(points, split), most) if most else np.zeros((0, 3), np.float32)


def depth_maps(points: Float[np.ndarray, "P 3"], split: Split) -> list[DepthMap]:
    """Depth of what stands still, from flow between each of at most `FRAMES` frames and others that see parallax.

    Args:
        points: of the scene, world units: how far apart views are, and what depths to think of.
        split: the frames.
    """
    cameras, greys = split.cameras, brightened(split.images)
    height, width = greys.shape[1:]
    some = points[:: -(-len(points) // LOOKED_AT)].astype(np.float64)
    matches = matcher(greys)

    def depths_of(frame: int) -> DepthMap:
        viewmat, K = (np.asarray(x[frame], np.float64) for x in (cameras.viewmat, cameras.K))
        _, seen, depth = points_inside(some, viewmat, K, (width, height))
        others = _partners(cameras, seen, depth, frame, FARTHEST * width)
        if not others:
            return DepthMap(viewmat, K, np.full((height, width), np.nan, np.float32))
        ends, errors = matches(frame, others)
        nearest, farthest = np.quantile(depth, (0.01, 0.99))
        geometry = epipolar_geometry(cameras, frame, others)
        inverse = triangulated(geometry, ends, errors < RETURNED, (DEPTHS[0] / farthest, DEPTHS[1] / nearest))
        if split.valid is not None:
            inverse[~split.valid[frame]] = np.nan
        return DepthMap(viewmat, K, inverse)

    frames = np.unique(np.linspace(0, len(greys) - 1, FRAMES).round().astype(int))
    in_time = frames[np.argsort(cameras.time[frames], kind="stable")]  # then flow is used again before it is forgotten
    return [*prefetch(depths_of, in_time.tolist())]


def triangulated(
    geometry: EpipolarGeometry,
    matches: Float32[np.ndarray, "K H W 2"],
    trusted: Bool[np.ndarray, "K H W"],
    bounds: tuple[float, float],
) -> Float32[np.ndarray, "H W"]:
    """Inverse depths that most matches of a view's pixels with K others agree on, 1 / world units; NaN without any.

    Every match proposes one. That which the others support most is fitted to those that do.

    Args:
        geometry: from the view to each of the others.
        matches: where they show what the view's pixels show.
        trusted: which of these count.
        bounds: least and greatest inverse depth to think of.
    """
    pixels = pixel_indices(*matches.shape[1:3]) + np.float32(0.5)
    far, a, b = depth_equations(geometry, pixels, matches)

    def support(inverse: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        apart = epipolar_residuals(geometry, far, matches, inverse) / np.float32(AGREED)
        return (np.maximum(1 - apart**2, 0) * trusted).sum(0)

    proposals = np.clip(proposed(a, b), *bounds).astype(np.float32)
    supports = np.where(trusted, np.stack([support(inverse) for inverse in proposals]), -1)
    best = np.take_along_axis(proposals, supports.argmax(0)[None], axis=0)[0]
    for _ in range(ROUNDS):
        agree = trusted & (epipolar_residuals(geometry, far, matches, best) < AGREED)
        # In pixels of the other view, errors of its equations are as small as what they are of is far away.
        weights = agree / np.maximum(far[..., 2] + best * geometry.e[:, 2, None, None].astype(np.float32), 1e-6) ** 2
        information = (weights * (b * b).sum(-1)).sum(0)
        fitted = -(weights * (a * b).sum(-1)).sum(0) / np.maximum(information, np.finfo(np.float32).tiny)
        best = np.where(information > 0, np.clip(fitted, *bounds), best).astype(np.float32)
    apart = epipolar_residuals(geometry, far, matches, best)
    against = (trusted & (apart > DISAGREED)).sum(0)
    known = (trusted & (apart < AGREED)).sum(0) >= 2
    known &= against <= AGAINST * trusted.sum(0)
    known &= EXACT * best * np.sqrt(information) > ACCURACY
    known &= (best > bounds[0]) & (best < bounds[1])
    return np.where(known, best, np.float32(np.nan))


def fused(points: Float[np.ndarray, "P 3"], maps: Sequence[DepthMap], most: int) -> Float32[np.ndarray, "N 3"]:
    """Points on what depth maps agree about, where no point is.

    Args:
        points: of the scene, world units.
        maps: of its frames.
        most: how many may be added.
    """
    together = np.asarray(points, np.float64)
    for index in np.random.default_rng(0).permutation(len(maps)):  # neighbours would tell the same, one by one
        spacing = max(SPACING, round((maps[index].inverse.size / most) ** 0.5))
        together = np.concatenate([together, _uncovered(together, maps[index], spacing)])
    added = together[len(points) :]
    agreeing, seen_through = np.zeros((2, len(added)), int)
    for depths in maps:
        ratio = _over_seen(added, depths)  # NaN compares as False
        agreeing += np.abs(ratio - 1) < ALIKE
        seen_through += ratio < 1 - PAST
    kept = np.flatnonzero((agreeing >= SEEN_IN) & (seen_through <= SEEN_THROUGH * agreeing))
    return added[kept[np.argsort(-agreeing[kept], kind="stable")[:most]]].astype(np.float32)


def _partners(
    cameras: Camera,
    seen: Float[np.ndarray, "S 2"],
    depth: Float[np.ndarray, " S"],
    frame: int,
    farthest: float,
) -> list[int]:
    """Frames to match a frame with: earlier and later, the nearest in time that shows each parallax.

    Args:
        cameras: of all frames.
        seen: pixels of points in the frame.
        depth: their depths.
        frame: index of the frame.
        farthest: pixels by which what they show may shift, in the median.
    """
    if not len(seen):
        return []
    instants = np.unique(cameras.time, return_inverse=True)[1].reshape(-1)
    offsets = instants - instants[frame]
    chosen: set[int] = set()
    for side in (offsets <= 0, offsets >= 0):
        near = np.flatnonzero(side & (np.abs(offsets) <= GAP))
        near = near[np.argsort(np.abs(offsets[near]), kind="stable")].tolist()
        parallaxes = []
        for other in near:
            geometry = epipolar_geometry(cameras, frame, other)
            ends = project(geometry, seen, 1 / depth)
            shift = np.median(np.linalg.norm(ends - seen, axis=-1))
            parallax = np.median(np.linalg.norm(ends - project(geometry, seen, 0 * depth), axis=-1))
            parallaxes.append(parallax if shift < farthest else 0)
        enough = np.array(parallaxes)[:, None] >= PARALLAXES
        chosen.update(near[first] for first in enough.argmax(0)[enough.any(0)].tolist())
    return sorted(chosen)


def _uncovered(points: Float[np.ndarray, "P 3"], depths: DepthMap, spacing: int) -> Float[np.ndarray, "N 3"]:
    """Points of a frame, one in a square of `spacing` pixels, where none of `points` is already."""
    viewmat, K, inverse = depths
    height, width = inverse.shape
    rows, columns = (np.arange(0, size, spacing) for size in (height, width))
    middles = np.minimum(rows + spacing // 2, height - 1)[:, None], np.minimum(columns + spacing // 2, width - 1)
    free = inverse[middles].astype(np.float64)
    _, (column, row), depth = _seen(points, depths)
    there = np.abs(depth * free[row // spacing, column // spacing] - 1) < SAME
    free[row[there] // spacing, column[there] // spacing] = np.nan

    row, column = (np.broadcast_to(middle, free.shape)[np.isfinite(free)] for middle in middles)
    pixels = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=-1)
    local = pixels @ np.linalg.inv(K).T / free[np.isfinite(free)][:, None]
    return local @ viewmat[:3, :3] + camera_centres(viewmat)


def _over_seen(points: Float[np.ndarray, "P 3"], depths: DepthMap) -> Float[np.ndarray, " P"]:
    """Depths of points in a frame over what it sees at their pixels; NaN where it does not know or see them."""
    ratio = np.full(len(points), np.nan)
    seen, (column, row), depth = _seen(points, depths)
    ratio[seen] = depth * depths.inverse[row, column]
    return ratio


def _seen(
    points: Float[np.ndarray, "P 3"], depths: DepthMap
) -> tuple[Bool[np.ndarray, " P"], Int[np.ndarray, "2 S"], Float[np.ndarray, " S"]]:
    """Which points lie inside a frame's picture, in which columns and rows, and their depths."""
    inside, pixels, depth = points_inside(points, depths.viewmat, depths.K, depths.inverse.shape[::-1])
    return inside, pixels.astype(int).T, depth
