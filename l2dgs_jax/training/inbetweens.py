"""Views between two frames of a video, made by optical flow, from which a scene learns to move instead of to fade.

A scene that is supervised at the frames only can explain a moving thing by static copies, one fading out as the next
fades in. That is wrong between the frames, and a view from there shows it. Such a view is interpolated from the frames
before and after it, each warped by its part of the flow between them (Super SloMo, arXiv 1712.00080).
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float16, Float32

from l2dgs_jax.cameras.flow import pixel_indices, relative_gain
from l2dgs_jax.cameras.geometry import between
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.training.flows import Flows
from l2dgs_jax.types import Camera

# A pixel is invalid if the two warped frames differ by more than a factor times the median over the view plus a margin.
MAX_OVER_MEDIAN = 5.0
MARGIN = 1 / 255  # sRGB


class View(NamedTuple):
    """What a camera would have seen.

    Attributes:
        camera: in NumPy arrays.
        frame: index of the frame whose image it shows, warped.
        image: sRGB in [0, 1].
        valid: where the image is known.
    """

    camera: Camera
    frame: int
    image: Float16[np.ndarray, "H W 3"]
    valid: Bool[np.ndarray, "H W"]


def draw(split: Split, flows: Flows, frame: int, part: float) -> View:
    """The view `part` of the way from a frame to the following one.

    Its image is that of the nearer of the two, warped. A pixel is valid where the flow of both is known and the warped
    frames, made equally bright, agree on its colour, which they do not at occlusions.
    """
    other = int(flows.following[frame])
    forward, backward = flows.displacements[frame].astype(np.float32)
    # Flow from the view to either frame, approximated by that between the frames.
    to_frames = (
        part**2 * backward - part * (1 - part) * forward,
        (1 - part) ** 2 * forward - part * (1 - part) * backward,
    )
    ends = (frame, other)
    (first, first_seen), (second, second_seen) = (_warped(split, *end) for end in zip(ends, to_frames, strict=True))
    valid = first_seen & second_seen
    as_bright = relative_gain(first[valid], second[valid]) * second
    difference = np.maximum(_dissimilarity(first, as_bright), _dissimilarity(as_bright, first))
    difference = cv2.blur(np.where(valid, difference, 0), (3, 3))
    valid &= difference < MAX_OVER_MEDIAN * (np.median(difference[valid]) if valid.any() else 0) + MARGIN
    nearer, shown = (first, frame) if part < 0.5 else (second, other)  # their mean would be less noisy, but blurred
    image = np.where(valid[..., None], np.clip(nearer, 0, 1), 0).astype(np.float16)
    return View(between(split.cameras, frame, other, part), shown, image, valid)


def _dissimilarity(
    first: Float32[np.ndarray, "H W 3"], second: Float32[np.ndarray, "H W 3"]
) -> Float32[np.ndarray, "H W"]:
    """How far colours of the first are outside the range that the second has within a pixel.

    This tolerates small errors of the flow at sharp edges (Birchfield and Tomasi, PAMI 1998).
    """
    window = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(second, window), cv2.dilate(second, window)
    return np.maximum(np.maximum(low - first, first - high), 0).mean(-1)


def _warped(
    split: Split, frame: int, flow: Float32[np.ndarray, "H W 2"]
) -> tuple[Float32[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """The image of a frame sampled at each pixel plus its flow, and where that is known."""
    image = split.images[frame].astype(np.float32)
    height, width = image.shape[:2]
    at = flow + pixel_indices(height, width)
    known: np.ndarray = np.all((at >= 0) & (at <= (width - 1, height - 1)), axis=-1)  # not where flow is NaN
    columns, rows = np.moveaxis(np.where(known[..., None], at, 0), -1, 0)
    if split.valid is not None:
        known &= cv2.remap(split.valid[frame].astype(np.float32), columns, rows, cv2.INTER_LINEAR) > 0.999
    return cv2.remap(image, columns, rows, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE), known
