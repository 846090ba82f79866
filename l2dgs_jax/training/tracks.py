"""Tracks of what moves: pixels whose optical flow differs from what the motion of the camera explains."""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Shaped, UInt8

from l2dgs_jax.cameras.epipolar import epipolar_geometry, project
from l2dgs_jax.cameras.flow import brightened, equally_exposed, pixel_indices
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.training.backdrop import DEPTH_CELL
from l2dgs_jax.training.flows import Flows

SPACING = 3  # side in pixels of the cells that hold one track each, where tracks begin and where they meet
MIN_DEVIATION = 1.0  # pixels by which flow must differ from that of a static scene at any depth
WINDOW = 5  # side in pixels of the window over which frames are compared
CLOSING = 7  # side in pixels of the morphological closing that fills holes in masks of moving pixels
UPDATE_WEIGHT = 0.3  # of the last step in the moving average of how far a track deviates from a static scene


class Tracks(NamedTuple):
    """Where the same spots are seen in several frames: O observations, grouped by track and in order of time.

    Attributes:
        numbers: of the tracks that the observations belong to.
        frames: indices of the frames that they are made in.
        pixels: their positions, pixel centres at +0.5.
        moves: whether the spot is seen to move from that frame to the following one.
    """

    numbers: Int[np.ndarray, " O"]
    frames: Int[np.ndarray, " O"]
    pixels: Float[np.ndarray, "O 2"]
    moves: Bool[np.ndarray, " O"]


def by_track(tracks: Tracks, values: Shaped[np.ndarray, "O ..."]) -> list[Shaped[np.ndarray, "_ ..."]]:
    """Values of all observations, track by track; if there are none, a single empty array."""
    return np.split(values, np.flatnonzero(np.diff(tracks.numbers)) + 1)


def by_frame(tracks: Tracks) -> list[Int[np.ndarray, " N"]]:
    """The observations of each frame that has any."""
    order = np.argsort(tracks.frames, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(tracks.frames[order])) + 1)


def share_in_track(tracks: Tracks, which: Bool[np.ndarray, " O"]) -> Float[np.ndarray, " O"]:
    """Share of the observations of each one's track for which something holds."""
    _, numbers = np.unique(tracks.numbers, return_inverse=True)
    return (np.bincount(numbers, which) / np.bincount(numbers))[numbers]


class _Heads(NamedTuple):
    """The tracks that have come to a frame: number, pixel, and average deviation from a static scene in pixels."""

    numbers: Int[np.ndarray, " N"]
    pixels: Float[np.ndarray, "N 2"]
    deviations: Float[np.ndarray, " N"]


T = TypeVar("T", Tracks, _Heads)


def find_tracks(split: Split, flows: Flows, depths: Float32[np.ndarray, "C F h w"]) -> Tracks:
    """Follow what moves from frame to frame, as long as flow can be trusted.

    A track begins in every cell that moves and has none, so that the tracks cover what moves at every instant. Where
    two meet, one of them is being occluded: the one that deviates more from a static scene goes on.

    Args:
        split: the frames.
        flows: between them.
        depths: of the static scene in the cells of each frame, C candidates, world units; NaN where unknown.
    """
    times, (height, width) = np.asarray(split.cameras.time), split.images.shape[1:3]
    greys = brightened(split.images)
    pixels = pixel_indices(height, width) + np.float32(0.5)
    grid = pixels[SPACING // 2 :: SPACING, SPACING // 2 :: SPACING].reshape(-1, 2).astype(np.float64)
    none = _Heads(np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))
    arrived: dict[int, list[_Heads]] = {frame: [none] for frame in range(len(times))}
    observed, count = [], 0
    for frame in np.argsort(times, kind="stable").tolist():
        heads = _foremost(_joined(arrived.pop(frame)), width)
        following = int(flows.following[frame])
        if following == frame:
            observed.append(_seen(heads, frame, np.zeros((height, width), bool)))
            continue
        geometry = epipolar_geometry(split.cameras, frame, following)
        inverse_depths = 1 / depths[:, frame].repeat(DEPTH_CELL, 1).repeat(DEPTH_CELL, 2)[:, :height, :width]
        static = [project(geometry, pixels, inverse).astype(np.float32) for inverse in inverse_depths]
        flow = flows.displacements[frame, 0].astype(np.float32)
        first, second = greys[frame], equally_exposed(greys[frame], greys[following])
        deviations, moves = _moving(first, second, static, pixels + flow)
        fresh = grid[_at(moves, grid) & ~np.isin(_cells(grid, width), _cells(heads.pixels, width))]
        heads = _joined([heads, _Heads(count + np.arange(len(fresh)), fresh, np.zeros(len(fresh)))])
        count += len(fresh)
        observed.append(_seen(heads, frame, moves))
        arrived[following].append(_carried(heads, flow, deviations))
    return in_order(observed, times)


def followed_back(
    tracks: Tracks, numbers: Int[np.ndarray, " N"], flows: Flows, times: Float[np.ndarray, " F"]
) -> Tracks:
    """Earlier observations of tracks: where flow says that they were before they began, moving or not.

    As long as it can be trusted, and no track is there; of several that arrive in one place, only the first goes on.

    Args:
        tracks: as found.
        numbers: of those to follow.
        flows: between the frames.
        times: of the frames.
    """
    height, width = flows.displacements.shape[2:4]
    found, begins = np.unique(tracks.numbers, return_index=True)
    begins = begins[np.isin(found, numbers)]
    numbers, frames, pixels = tracks.numbers[begins], tracks.frames[begins], tracks.pixels[begins]
    earlier = [Tracks(*(x[:0] for x in tracks))]
    for frame in np.argsort(-times, kind="stable").tolist():
        following = int(flows.following[frame])
        if following == frame:
            continue
        heads = np.flatnonzero(frames == following)
        places = pixels[heads] + _at(flows.displacements[frame, 1].astype(np.float32), pixels[heads])
        free = _inside(places, height, width)
        taken = _cells(tracks.pixels[tracks.frames == frame], width)
        free[free] = ~np.isin(_cells(places[free], width), taken)
        heads, places = heads[free], places[free]
        one = np.unique(_cells(places, width), return_index=True)[1]
        heads, places = heads[one], places[one]
        frames[heads], pixels[heads] = frame, places
        earlier.append(Tracks(numbers[heads], frames[heads], places, np.zeros(len(heads), bool)))
    return in_order(earlier, times)


def in_order(parts: Sequence[Tracks], times: Float[np.ndarray, " F"]) -> Tracks:
    """All observations together, grouped by track and in order of time."""
    together = _joined(parts)
    order = np.lexsort((times[together.frames], together.numbers))
    return Tracks(*(x[order] for x in together))


def _joined(parts: Sequence[T]) -> T:
    """All of them as one, in that order."""
    return type(parts[0])(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _inside(pixels: Float[np.ndarray, "N 2"], height: int, width: int) -> Bool[np.ndarray, " N"]:
    """Which pixels lie within a frame; not where they are NaN, as flow is that is not trusted."""
    return np.all((pixels >= 0) & (pixels < (width, height)), axis=-1)


def _cells(pixels: Float[np.ndarray, "N 2"], width: int) -> Int[np.ndarray, " N"]:
    """Numbers of the cells that pixels of a frame of that width lie in."""
    column, row = (pixels // SPACING).astype(int).T
    return row * width + column


def _foremost(heads: _Heads, width: int) -> _Heads:
    """The track in each cell that deviates most."""
    order = np.argsort(-heads.deviations, kind="stable")
    first = order[np.unique(_cells(heads.pixels[order], width), return_index=True)[1]]
    return _Heads(*(x[first] for x in heads))


def _seen(heads: _Heads, frame: int, moves: Bool[np.ndarray, "H W"]) -> Tracks:
    """Observations of these tracks in a frame; `moves` tells which of its pixels move."""
    return Tracks(heads.numbers, np.full(len(heads.numbers), frame), heads.pixels, _at(moves, heads.pixels))


def _carried(heads: _Heads, flow: Float32[np.ndarray, "H W 2"], deviations: Float32[np.ndarray, "H W"]) -> _Heads:
    """The tracks that flow carries to a place in the following frame; it is NaN where it is not to be trusted."""
    ends = heads.pixels + _at(flow, heads.pixels)
    inside = _inside(ends, *deviations.shape)
    latest = np.nan_to_num(_at(deviations, heads.pixels))
    average = (1 - UPDATE_WEIGHT) * heads.deviations + UPDATE_WEIGHT * latest
    return _Heads(heads.numbers[inside], ends[inside], average[inside])


def _moving(
    first: UInt8[np.ndarray, "H W"],
    second: UInt8[np.ndarray, "H W"],
    static: Sequence[Float32[np.ndarray, "H W 2"]],
    moved: Float32[np.ndarray, "H W 2"],
) -> tuple[Float32[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """How far the flow of a frame's pixels deviates from a static scene, in pixels, and where they surely move.

    Flow drifts where there is no texture. It is believed where the second frame matches the first better by it than by
    a static scene at any candidate depth, by a margin of the median difference of the two frames; and in holes of the
    mask of such pixels.

    Args:
        first: brightened grey frame.
        second: likewise, as bright as the first.
        static: pixels of the second frame where a static scene would appear, for each candidate of its depth.
        moved: pixels of the second frame that flow leads to; NaN where it is not trusted.
    """
    deviations = np.min([np.linalg.norm(moved - places, axis=-1) for places in static], axis=0)
    known = np.isfinite(deviations)

    def difference(at: Float32[np.ndarray, "H W 2"]) -> Float32[np.ndarray, "H W"]:
        x, y = np.moveaxis(np.where(known[..., None], at, 0) - np.float32(0.5), -1, 0)
        warped = cv2.remap(second.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return cv2.blur(np.abs(warped - first.astype(np.float32)), (WINDOW, WINDOW))

    moved_difference = difference(moved)
    static_difference = np.min([difference(places) for places in static], axis=0)
    margin = np.median(moved_difference[known]) if known.any() else 0
    believed = (deviations > MIN_DEVIATION) & (static_difference - moved_difference > margin)
    filled = cv2.morphologyEx(believed.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((CLOSING, CLOSING), np.uint8)) > 0
    return deviations, filled & (deviations > MIN_DEVIATION)


def _at(values: np.ndarray, pixels: Float[np.ndarray, "N 2"]) -> np.ndarray:
    """Values [H W ...] of the pixels."""
    column, row = pixels.astype(int).T
    return values[row, column]
