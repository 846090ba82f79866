"""Optical flow from frame to frame of a video: what views between frames, and tracks, are made of."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float16, Float32, Int, UInt8

from l2dgs_jax.cameras.flow import brightened, match, optical_flow, pixel_indices, smooth_flow
from l2dgs_jax.cameras.geometry import camera_centres
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.stacks import MappedArray, stacked
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera

SIZES = 0.5, 0.25, 0.125  # of pictures, over the frames', that show where to what is not found in these
RETURNED = 1.5  # pixels from its start within which flow there and back must end to be trusted
UNEXPLAINED = 0.8  # part of a picture's variance that may remain where the other is taken for it


class Flows(NamedTuple):
    """Optical flow between neighbouring frames.

    Attributes:
        following: the frame after each one; itself where flow cannot tell.
        displacements: pixels, from a frame to the following one and back again; NaN where they cannot be trusted.
    """

    following: Int[np.ndarray, " F"]
    displacements: Float16[np.ndarray, "F 2 H W 2"]


def neighbour_flows(split: Split, *, filled: bool = False) -> Flows:
    """Optical flow between frames that follow each other in time, of the cameras that are next to each other.

    Args:
        split: the frames.
        filled: look for what patches lose by smooth flow, in smaller and smaller pictures.
    """
    following, greys = _following(split.cameras), brightened(split.images)

    def both_ways(frame: int) -> Float16[np.ndarray, "2 H W 2"]:
        first, second = greys[frame], greys[following[frame]]
        found = _trusted(optical_flow(first, second), optical_flow(second, first))
        for size in SIZES if filled else ():
            more = _trusted(smooth_flow(first, second, size), smooth_flow(second, first, size))
            found = np.where(np.isfinite(found), found, more)
        alike = _explains(first, second, found[0]) and _explains(second, first, found[1])
        return (found if alike else np.full_like(found, np.nan)).astype(np.float16)

    frames = range(len(greys))
    shape = (len(greys), 2, *greys.shape[1:], 2)
    in_file = isinstance(split.images, MappedArray)
    displacements = stacked(prefetch(both_ways, frames), shape, np.float16, in_file)
    told = [bool(np.isfinite(flow).any()) for flow in displacements]
    return Flows(np.where(told, following, frames), displacements)


def _following(cameras: Camera) -> Int[np.ndarray, " F"]:
    """The frame of the next instant whose camera is nearest to each frame's; the frame itself at the last instant."""
    centres, times = camera_centres(np.asarray(cameras.viewmat, np.float64)), np.asarray(cameras.time)

    def after(frame: int) -> int:
        later = times[times > times[frame]]
        candidates = np.flatnonzero(times == later.min()) if len(later) else np.array([frame])
        return int(candidates[np.linalg.norm(centres[candidates] - centres[frame], axis=-1).argmin()])

    return np.array([after(frame) for frame in range(len(times))])


def _trusted(there: Float32[np.ndarray, "H W 2"], back: Float32[np.ndarray, "H W 2"]) -> Float32[np.ndarray, "2 H W 2"]:
    """Both of them, each NaN where the other does not lead back."""
    errors = np.stack([match(there, back).errors, match(back, there).errors])
    return np.where(errors[..., None] < RETURNED, np.stack([there, back]), np.float32(np.nan))


def _explains(
    first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"], flow: Float32[np.ndarray, "H W 2"]
) -> bool:
    """Whether the second picture, where flow finds it, tells enough of the first, so that the two show one scene.

    Smooth flow leads there and back between any two pictures, after a cut as well.
    """
    known = np.isfinite(flow[..., 0])
    at = np.where(known[..., None], flow, 0) + pixel_indices(*first.shape)
    seen = cv2.remap(second.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    left = first - np.where(known, seen, first.mean())
    return bool(known.any() and np.square(left).mean() <= UNEXPLAINED * first.var())
