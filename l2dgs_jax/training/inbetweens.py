"""Views between two frames of a video, drawn by optical flow: what teaches a scene to move, not to fade.

A scene that sees a moving thing only where frames show it can explain them by two still copies, one fading out as the
other fades in. Between the frames that is wrong, and a view from there says so. Such a view is drawn from the frames
before and after it, warped by their part of the flow between them (Super SloMo, arXiv 1712.00080).
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float16, Float32, Int

from l2dgs_jax.cameras.flow import brightened, match, optical_flow
from l2dgs_jax.cameras.geometry import between, camera_centres
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.stacks import MappedArray, stacked
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera

RETURNED = 1.5  # pixels from its start within which flow there and back must end to be trusted
LEAST_TRUSTED = 0.6  # part of a picture whose flow must be trusted for views to be drawn from it
DISAGREEMENT = 5.0  # of the two warped frames, in medians over the picture, that voids a pixel
LEVELS = 2 / 255  # by which they may differ in any case, sRGB


class Flows(NamedTuple):
    """Optical flow between neighbouring frames.

    Attributes:
        following: the frame after each one; itself where flow cannot tell.
        displacements: pixels, from a frame to the following one and back again; NaN where they cannot be trusted.
    """

    following: Int[np.ndarray, " F"]
    displacements: Float16[np.ndarray, "F 2 H W 2"]


class View(NamedTuple):
    """What a camera would have seen.

    Attributes:
        camera: in NumPy arrays.
        image: sRGB in [0, 1].
        valid: where that is known.
    """

    camera: Camera
    image: Float16[np.ndarray, "H W 3"]
    valid: Bool[np.ndarray, "H W"]


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


def draw(split: Split, flows: Flows, frame: int, part: float) -> View:
    """The view `part` of the way from a frame to the following one.

    It is the nearer of the two, warped. A pixel is valid where the flow of both is known and they agree on its colour,
    as they do not where one of them hides what the other shows.
    """
    other = int(flows.following[frame])
    there, back = flows.displacements[frame].astype(np.float32)
    towards = (part**2 * back - part * (1 - part) * there, (1 - part) ** 2 * there - part * (1 - part) * back)
    images = [split.images[index].astype(np.float32) for index in (frame, other)]
    (first, first_seen), (second, second_seen) = map(_warped, images, towards)
    valid = first_seen & second_seen
    apart = cv2.blur(np.where(valid, np.abs(first - second).mean(-1), 0), (3, 3))
    valid &= apart < DISAGREEMENT * (np.median(apart[valid]) if valid.any() else 0) + LEVELS
    if split.valid is not None:
        valid &= split.valid[frame] & split.valid[other]
    nearer = first if part < 0.5 else second  # their mean would be less noisy, and less sharp
    image = np.where(valid[..., None], np.clip(nearer, 0, 1), 0).astype(np.float16)
    return View(between(split.cameras, frame, other, part), image, valid)


def _warped(
    image: Float32[np.ndarray, "H W 3"], flow: Float32[np.ndarray, "H W 2"]
) -> tuple[Float32[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """The image seen at each pixel plus its flow, and where that is known."""
    height, width = image.shape[:2]
    at = flow + np.stack(np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)), axis=-1)
    known: np.ndarray = np.all((at >= 0) & (at <= (width - 1, height - 1)), axis=-1)  # not where flow is NaN
    at = np.where(known[..., None], at, 0)
    return cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE), known
