"""The tracks that are surely of moving things, and where these begin and end."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from l2dgs_jax.cameras.geometry import project_points
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.stacks import MappedArray, stacked
from l2dgs_jax.training.backdrop import Backdrop, depths_at, unprojected
from l2dgs_jax.training.background import likeness_to_background
from l2dgs_jax.training.flows import Flows, neighbour_flows
from l2dgs_jax.training.tracks import MIN_DEVIATION, Tracks, by_track, find_tracks, followed_back, in_order
from l2dgs_jax.types import Camera

MIN_LENGTH = 3  # frames that a track must be seen in
MIN_MOVING_SHARE = 0.4  # share of these frames in which it must be seen to move
MIN_DEPARTURE = 3.0  # pixels that a track must at some time be away from where a static point would appear
# Pixels by which what sets off slowly deviates in its first step; tracks begin where it is more than MIN_DEVIATION.
# What is faster at first has come out from behind something, or into the picture.
MAX_START = 1.5
MIN_GROWTH = 1.2  # factor by which tracks must cover more of the clip for every second instant to be left out
MIN_INSTANTS = 30  # that must remain


class Followed(NamedTuple):
    """Tracks, and the frames that they were found in.

    Attributes:
        split: the frames.
        backdrop: the static scene behind.
        tracks: of what moves.
    """

    split: Split
    backdrop: Backdrop
    tracks: Tracks


def moving_tracks(split: Split, backdrop: Backdrop, most: int) -> Followed:
    """Tracks of what surely moves, from before it sets off until it rests; none where no flow can be trusted.

    Slow motion, or many frames a second, move things by less from frame to frame than flow errs. If tracks between
    every second instant cover much more, the other instants are left out, and so on with every fourth or eighth.

    Args:
        split: the frames.
        backdrop: the static scene behind.
        most: how many tracks there may be; the longest ones are preferred.
    """
    best = followed = Followed(split, backdrop, _among(split, backdrop, most))
    while len(instants := np.unique(times := followed.backdrop.cameras.time)) >= 2 * MIN_INSTANTS:
        kept = np.flatnonzero(np.isin(times, instants[::2]))
        fewer = _frames(followed.split, kept), followed.backdrop.of(kept)
        followed = Followed(*fewer, _among(*fewer, most))
        covered, before = (len(x.tracks.numbers) / len(x.split.names) for x in (followed, best))
        if covered > MIN_GROWTH * before:
            best = followed
        elif before:
            break
    return best


def _among(split: Split, backdrop: Backdrop, most: int) -> Tracks:
    flows = neighbour_flows(split)
    chosen = surely_moving(find_tracks(split, flows, backdrop.depths.still), backdrop, most)
    return until_rest(from_rest(chosen, flows, split, backdrop), split, backdrop)


def _frames(split: Split, kept: Int[np.ndarray, " N"]) -> Split:
    """Some of the frames, with what is needed to follow and place what moves."""

    def some(stack: Shaped[np.ndarray, "F ..."]) -> Shaped[np.ndarray, "N ..."]:
        shape = (len(kept), *stack.shape[1:])
        return stacked((stack[i] for i in kept), shape, stack.dtype, isinstance(stack, MappedArray))

    names, cameras = tuple(split.names[i] for i in kept), Camera(*(x[kept] for x in split.cameras))
    valid, depths = (None if x is None else some(x) for x in (split.valid, split.depths))
    return Split(names, cameras, some(split.images), valid=valid, depths=depths)


def surely_moving(tracks: Tracks, backdrop: Backdrop, most: int) -> Tracks:
    """The tracks that are long enough and surely move, the longest ones first.

    They are seen to move in enough of their frames, and leave the place where their first point, taken as static, would
    appear at any candidate depth.
    """
    starts = np.flatnonzero(np.diff(tracks.numbers, prepend=-1))
    lengths = np.diff(starts, append=len(tracks.numbers))
    if not len(starts):
        return tracks
    moving_share = np.add.reduceat(tracks.moves, starts) / lengths
    deviations = _deviations(tracks, np.repeat(starts, lengths), np.arange(len(tracks.numbers)), backdrop)
    deviates = np.maximum.reduceat(deviations, starts, axis=1).min(0) > MIN_DEPARTURE  # not where a depth is NaN
    kept = np.flatnonzero((lengths >= MIN_LENGTH) & (moving_share > MIN_MOVING_SHARE) & deviates)
    chosen = kept[np.argsort(-lengths[kept], kind="stable")[:most]]
    observed = np.concatenate([starts[i] + np.arange(lengths[i]) for i in chosen]) if len(chosen) else chosen
    return Tracks(*(x[observed] for x in tracks))


def _deviations(
    tracks: Tracks, first: Int[np.ndarray, " N"], then: Int[np.ndarray, " N"], backdrop: Backdrop
) -> Float[np.ndarray, "C N"]:
    """Pixels from observations to where others, taken as static, would appear in the same frame.

    They are infinite where the camera has passed by the static point, and NaN where its depth is not known.

    Args:
        tracks: all observations.
        first: those that are taken as static, at each of C candidates of their depth, some of which may be NaN.
        then: those that are compared with them.
        backdrop: the static scene.
    """
    cameras, frames, pixels = backdrop.cameras, tracks.frames, tracks.pixels
    deviations = []
    for still in backdrop.depths.still:
        world = unprojected(cameras, frames[first], pixels[first], depths_at(still, frames[first], pixels[first]))
        static, _ = project_points(world, cameras.viewmat[frames[then]], cameras.K[frames[then]])
        behind = np.isnan(static).any(-1) & np.isfinite(world).all(-1)
        deviations.append(np.where(behind, np.inf, np.linalg.norm(pixels[then] - static, axis=-1)))
    return np.array(deviations)


def _steps(tracks: Tracks, backdrop: Backdrop) -> Float[np.ndarray, " O"]:
    """Pixels by which the step from each observation to the next one deviates from a static point; 0 at the last."""
    before = np.flatnonzero(np.diff(tracks.numbers) == 0)
    steps = np.zeros(len(tracks.numbers))
    steps[before] = _deviations(tracks, before, before + 1, backdrop).min(0)
    return steps


def _then_or_later(tracks: Tracks, holds: Bool[np.ndarray, " O"]) -> Bool[np.ndarray, " O"]:
    """Whether something holds for each observation or for a later one of its track."""
    return np.concatenate([np.flip(np.logical_or.accumulate(np.flip(part))) for part in by_track(tracks, holds)])


def from_rest(tracks: Tracks, flows: Flows, split: Split, backdrop: Backdrop) -> Tracks:
    """The tracks, and what flow says of those that set off slowly before they were seen to move.

    It is believed as long as they differ there from the background that is seen in their place at other times.

    Args:
        tracks: of moving things.
        flows: that they were found by.
        split: the frames.
        backdrop: the static scene behind.
    """
    times = backdrop.cameras.time
    numbers, begins = np.unique(tracks.numbers, return_index=True)
    slow = numbers[_steps(tracks, backdrop)[begins] < MAX_START]
    earlier = followed_back(tracks, slow, flows, times)
    together = in_order([tracks, earlier], times)
    likeness = likeness_to_background(earlier.frames, earlier.pixels, split, backdrop, together)
    believed = ~_then_or_later(earlier, ~likeness.differs)
    return in_order([tracks, Tracks(*(x[believed] for x in earlier))], times)


def until_rest(tracks: Tracks, split: Split, backdrop: Backdrop) -> Tracks:
    """The tracks without what follows once they rest and show the background: flow has lost them there.

    Those of which little remains are left out.

    Args:
        tracks: of moving things.
        split: the frames.
        backdrop: the static scene behind.
    """
    background = likeness_to_background(tracks.frames, tracks.pixels, split, backdrop, tracks).alike
    moves = _steps(tracks, backdrop) > MIN_DEVIATION
    moves[1:] |= moves[:-1]  # to it or from it
    lost = by_track(tracks, background & ~_then_or_later(tracks, moves))
    kept = [~np.logical_or.accumulate(part) for part in lost]
    long_enough = [part & (part.sum() >= MIN_LENGTH) for part in kept]
    return Tracks(*(x[np.concatenate(long_enough)] for x in tracks))
