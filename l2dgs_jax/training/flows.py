"""Optical flow from frame to frame of a video: what views between frames, and tracks, are made of."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float16, Float32, Int

from l2dgs_jax.cameras.flow import brightened, match, optical_flow
from l2dgs_jax.cameras.geometry import camera_centres
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.stacks import MappedArray, stacked
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera

RETURNED = 1.5  # pixels from its start within which flow there and back must end to be trusted
LEAST_TRUSTED = 0.6  # part of a picture whose flow must be trusted for anything to be made of it


class Flows(NamedTuple):
    """Optical flow between neighbouring frames.

    Attributes:
        following: the frame after each one; itself where flow cannot tell.
        displacements: pixels, from a frame to the following one and back again; NaN where they cannot be trusted.
    """

    following: Int[np.ndarray, " F"]
    displacements: Float16[np.ndarray, "F 2 H W 2"]


def neighbour_flows(split: Split) -> Flows:
    """Optical flow between frames that follow each other in time, of the cameras that are next to each other."""
    following, greys = _following(split.cameras), brightened(split.images)

    def both_ways(frame: int) -> Float16[np.ndarray, "2 H W 2"]:
        other = following[frame]
        there, back = optical_flow(greys[frame], greys[other]), optical_flow(greys[other], greys[frame])
        return np.stack([_trusted(there, back), _trusted(back, there)]).astype(np.float16)

    frames = range(len(greys))
    shape = (len(greys), 2, *greys.shape[1:], 2)
    in_file = isinstance(split.images, MappedArray)
    displacements = stacked(prefetch(both_ways, frames), shape, np.float16, in_file)
    told = [np.isfinite(flow[..., 0]).mean() >= LEAST_TRUSTED for flow in displacements]
    return Flows(np.where(told, following, frames), displacements)


def _following(cameras: Camera) -> Int[np.ndarray, " F"]:
    """The frame of the next instant whose camera is nearest to each frame's; the frame itself at the last instant."""
    centres, times = camera_centres(np.asarray(cameras.viewmat, np.float64)), np.asarray(cameras.time)

    def after(frame: int) -> int:
        later = times[times > times[frame]]
        candidates = np.flatnonzero(times == later.min()) if len(later) else np.array([frame])
        return int(candidates[np.linalg.norm(centres[candidates] - centres[frame], axis=-1).argmin()])

    return np.array([after(frame) for frame in range(len(times))])


def _trusted(there: Float32[np.ndarray, "H W 2"], back: Float32[np.ndarray, "H W 2"]) -> Float32[np.ndarray, "H W 2"]:
    return np.where(match(there, back).errors[..., None] < RETURNED, there, np.float32(np.nan))
