"""Tracks of what moves: pixels that optical flow carries elsewhere than the motion of the camera would."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from l2dgs_jax.cameras.epipolar import epipolar_geometry, project
from l2dgs_jax.cameras.flow import brightened, pixel_indices
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.training.flows import Flows

SPACING = 3  # pixels between tracks, at their start and where they meet
APART = 1.0  # pixels by which flow must differ from what a still scene would show
NEIGHBOURHOOD = 5  # pixels a side that pictures are compared over
HOLES = 7  # pixels a side, of what is filled in amid moving pixels
DEPTH_CELL = 4  # pixels a side of a square that has one depth
FORGETTING = 0.3  # weight of the last step in how fast a track strays


class Tracks(NamedTuple):
    """Where the same spots are seen in several frames: O observations, those of a track together, in order of time.

    Attributes:
        numbers: which track it belongs to.
        frames: which frame it was made in.
        pixels: where, pixel centres at +0.5.
        moves: whether it was seen to move from there.
    """

    numbers: Int[np.ndarray, " O"]
    frames: Int[np.ndarray, " O"]
    pixels: Float[np.ndarray, "O 2"]
    moves: Bool[np.ndarray, " O"]


def find_tracks(split: Split, flows: Flows, depths: Float32[np.ndarray, "C F h w"]) -> Tracks:
    """Follow what moves from frame to frame, as long as flow can be trusted.

    A track begins wherever something moves and none is near, so that together they cover it at every instant. Where two
    meet, one of them is being hidden: the one that strays more from a still scene goes on.

    Args:
        split: the frames.
        flows: between them.
        depths: those that a still scene may have in cells of each of them, C guesses, world units; NaN where nothing is
            known.
    """
    times, (height, width) = np.asarray(split.cameras.time), split.images.shape[1:3]
    greys = brightened(split.images)
    pixels = pixel_indices(height, width) + np.float32(0.5)
    grid = pixels[SPACING // 2 :: SPACING, SPACING // 2 :: SPACING].reshape(-1, 2).astype(np.float64)

    def cell(pixels: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, " N"]:
        column, row = (pixels // SPACING).astype(int).T
        return row * width + column

    class Heads(NamedTuple):
        """The tracks that have come to a frame: number, pixel, and how far they strayed in the last steps."""

        numbers: Int[np.ndarray, " N"]
        pixels: Float[np.ndarray, "N 2"]
        strays: Float[np.ndarray, " N"]

    none = Heads(np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))
    arrived: dict[int, list[Heads]] = {frame: [none] for frame in range(len(times))}
    observed, count = [], 0
    for frame in np.argsort(times, kind="stable").tolist():
        heads = Heads(*(np.concatenate(parts) for parts in zip(*arrived.pop(frame), strict=True)))
        order = np.argsort(-heads.strays, kind="stable")
        first = order[np.unique(cell(heads.pixels[order]), return_index=True)[1]]
        heads = Heads(*(x[first] for x in heads))
        following = int(flows.following[frame])
        if following == frame:
            still = np.zeros(len(heads.numbers), bool)
            observed.append(Tracks(heads.numbers, np.full(len(still), frame), heads.pixels, still))
            continue

        geometry = epipolar_geometry(split.cameras, frame, following)
        nearness = 1 / depths[:, frame].repeat(DEPTH_CELL, 1).repeat(DEPTH_CELL, 2)[:, :height, :width]
        places = [project(geometry, pixels, guess).astype(np.float32) for guess in nearness]
        flow = flows.displacements[frame, 0].astype(np.float32)
        strays, moves = _moving(greys[frame], greys[following], places, pixels + flow)
        if split.valid is not None:
            moves &= split.valid[frame]
        fresh = grid[_at(moves, grid) & ~np.isin(cell(grid), cell(heads.pixels))]
        numbers = count + np.arange(len(fresh))
        count += len(fresh)
        heads = Heads(*(np.concatenate(x) for x in zip(heads, (numbers, fresh, np.zeros(len(fresh))), strict=True)))
        seen = np.full(len(heads.numbers), frame), heads.pixels, _at(moves, heads.pixels)
        observed.append(Tracks(heads.numbers, *seen))

        ends = heads.pixels + _at(flow, heads.pixels)
        going = ((ends >= 0) & (ends < (width, height))).all(-1)  # not where flow is NaN
        last = (1 - FORGETTING) * heads.strays + FORGETTING * np.nan_to_num(_at(strays, heads.pixels))
        arrived[following].append(Heads(heads.numbers[going], ends[going], last[going]))
    together = Tracks(*(np.concatenate(parts) for parts in zip(*observed, strict=True)))
    order = np.lexsort((times[together.frames], together.numbers))
    return Tracks(*(x[order] for x in together))


def _moving(
    first: UInt8[np.ndarray, "H W"],
    second: UInt8[np.ndarray, "H W"],
    still: Sequence[Float32[np.ndarray, "H W 2"]],
    moved: Float32[np.ndarray, "H W 2"],
) -> tuple[Float32[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """How far pixels of a frame moved, and where they did beyond doubt.

    Flow wanders where there is nothing to hold on to. It is believed where the second frame looks more like the first
    one at its ends than where a still scene would be seen at any depth, by more than the two usually differ; and in
    holes of that.

    Args:
        first: brightened grey picture.
        second: likewise.
        still: pixels of the second frame where a still scene would be seen, for each guess of its depth.
        moved: where flow leads; NaN where it cannot be trusted.
    """
    strays = np.min([np.linalg.norm(moved - places, axis=-1) for places in still], axis=0)
    known = np.isfinite(strays)

    def difference(at: Float32[np.ndarray, "H W 2"]) -> Float32[np.ndarray, "H W"]:
        x, y = np.moveaxis(np.where(known[..., None], at, 0) - np.float32(0.5), -1, 0)
        seen = cv2.remap(second.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return cv2.blur(np.abs(seen - first.astype(np.float32)), (NEIGHBOURHOOD, NEIGHBOURHOOD))

    unlike = difference(moved)
    usual = np.median(unlike[known]) if known.any() else 0
    believed = (strays > APART) & (np.min([difference(places) for places in still], axis=0) - unlike > usual)
    filled = cv2.morphologyEx(believed.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((HOLES, HOLES), np.uint8)) > 0
    return strays, filled & (strays > APART)


def _at(values: np.ndarray, pixels: Float[np.ndarray, "N 2"]) -> np.ndarray:
    """Values [H W ...] of the pixels."""
    column, row = pixels.astype(int).T
    return values[row, column]
