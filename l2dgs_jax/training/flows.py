"""Optical flow from frame to frame of a video, from which views between frames and tracks are made."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float16, Float32, Int, UInt8

from l2dgs_jax.cameras.flow import (
    brightened,
    equally_exposed,
    match,
    optical_flow,
    smooth_flow,
    surely_valid,
    warped,
)
from l2dgs_jax.cameras.geometry import camera_centres
from l2dgs_jax.cameras.jumps import follow_jumps, unexplained
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.stacks import MappedArray, stacked
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera

SMOOTH_FLOW_SIZES = 0.5, 0.25, 0.125  # of downscaled frames, in which smooth flow finds what patches lose
# Pixels, see `follow_jumps`. Patches at outlines are found a little beside their place, which harms tracks. Views in
# between are not harmed: there, pixels that are wrong are found out.
MIN_JUMP = 7.0
MAX_FORWARD_BACKWARD_ERROR = 1.5  # pixels; flow of a larger error is not trusted
MAX_UNEXPLAINED = 0.8  # share of a frame's variance that warping the other may leave; more means a cut between them


class Flows(NamedTuple):
    """Optical flow between neighbouring frames.

    Attributes:
        following: the frame after each one; itself if there is none or the flow to it is not usable.
        displacements: pixels, from a frame to the following one and back again; NaN where they are not trusted, among
            them those of pixels that are not valid, or beside such.
    """

    following: Int[np.ndarray, " F"]
    displacements: Float16[np.ndarray, "F 2 H W 2"]


def neighbour_flows(split: Split, *, filled: bool = False) -> Flows:
    """Optical flow between frames that follow each other in time; with several cameras, the nearest one.

    Args:
        split: the frames.
        filled: whether jumps may be short, and smooth flow, at smaller and smaller sizes, fills in where patches find
            no flow to trust.
    """
    following, greys = _following(split.cameras), brightened(split.images)

    def both_directions(frame: int) -> Float16[np.ndarray, "2 H W 2"]:
        first, second = greys[frame], equally_exposed(greys[frame], greys[following[frame]])
        found = _with_jumps(first, second, 0.0 if filled else MIN_JUMP)
        for size in SMOOTH_FLOW_SIZES if filled else ():
            smooth = _consistent(smooth_flow(first, second, size), smooth_flow(second, first, size))
            found = np.where(np.isfinite(found), found, smooth)
        valid = np.ones(found.shape[:3], bool)
        if split.valid is not None:
            valid = np.stack([surely_valid(split.valid[index]) for index in (frame, following[frame])])
        trusted = valid & (
            _explains(first, second, found[0], valid[0]) and _explains(second, first, found[1], valid[1])
        )
        return np.where(trusted[..., None], found, np.float32(np.nan)).astype(np.float16)

    frames = range(len(greys))
    shape = (len(greys), 2, *greys.shape[1:], 2)
    in_file = isinstance(split.images, MappedArray)
    displacements = stacked(prefetch(both_directions, frames), shape, np.float16, in_file)
    usable = [bool(np.isfinite(flow).any()) for flow in displacements]
    return Flows(np.where(usable, following, frames), displacements)


def _following(cameras: Camera) -> Int[np.ndarray, " F"]:
    """The frame of the next instant whose camera is nearest to each frame's; the frame itself at the last instant."""
    centres, times = camera_centres(np.asarray(cameras.viewmat, np.float64)), np.asarray(cameras.time)

    def after(frame: int) -> int:
        later = times[times > times[frame]]
        candidates = np.flatnonzero(times == later.min()) if len(later) else np.array([frame])
        return int(candidates[np.linalg.norm(centres[candidates] - centres[frame], axis=-1).argmin()])

    return np.array([after(frame) for frame in range(len(times))])


def _with_jumps(
    first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"], shortest: float
) -> Float32[np.ndarray, "2 H W 2"]:
    """The flow from either frame to the other, by patches; NaN where it is not to be trusted."""
    pairs = (first, second), (second, first)
    flows = [optical_flow(*pair) for pair in pairs]
    found = _consistent(*flows)
    lost = [unexplained(*pair, flow) for pair, flow in zip(pairs, found, strict=True)]
    (far, jumps), (far_back, jumps_back) = (
        follow_jumps(*pair, flow, where, shortest) for pair, flow, where in zip(pairs, flows, lost, strict=True)
    )
    with_jumps = _consistent(far, far_back)
    # Where the search from coarse to fine succeeds in one direction only, it is a jump, too.
    either = jumps | _seen_from(far, jumps_back), jumps_back | _seen_from(far_back, jumps)
    explained = [~unexplained(*pair, flow) for pair, flow in zip(pairs, with_jumps, strict=True)]
    return np.where((np.stack(either) & np.stack(explained))[..., None], with_jumps, found)


def _seen_from(flow: Float32[np.ndarray, "H W 2"], mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """The mask of a frame, at the pixels of the frame from which the flow leads to it."""
    return warped(mask.astype(np.uint8), flow) > 0.5


def _consistent(
    forward: Float32[np.ndarray, "H W 2"], backward: Float32[np.ndarray, "H W 2"]
) -> Float32[np.ndarray, "2 H W 2"]:
    """Both flows, each NaN where its forward-backward error is too large."""
    errors = np.stack([match(forward, backward).errors, match(backward, forward).errors])
    trusted = errors[..., None] < MAX_FORWARD_BACKWARD_ERROR
    return np.where(trusted, np.stack([forward, backward]), np.float32(np.nan))


def _explains(
    first: UInt8[np.ndarray, "H W"],
    second: UInt8[np.ndarray, "H W"],
    flow: Float32[np.ndarray, "H W 2"],
    valid: Bool[np.ndarray, "H W"],
) -> bool:
    """Whether the second frame, warped by the flow, predicts the first where valid well enough to show the same scene.

    Forward-backward errors do not tell: smooth flow is consistent between any two frames, even across a cut.
    """
    known = np.isfinite(flow[valid][:, 0])
    if not known.any():
        return False
    actual, predicted = first[valid], warped(second, np.nan_to_num(flow))[valid]
    residual = actual - np.where(known, predicted, actual.mean())
    return bool(np.square(residual).mean() <= MAX_UNEXPLAINED * actual.var())
