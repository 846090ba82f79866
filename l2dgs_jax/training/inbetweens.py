"""Views between two frames of a video, drawn by optical flow: what teaches a scene to move, not to fade.

A scene that sees a moving thing only where frames show it can explain them by two still copies, one fading out as the
other fades in. Between the frames that is wrong, and a view from there says so. Such a view is drawn from the frames
before and after it, warped by their part of the flow between them (Super SloMo, arXiv 1712.00080).
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float16, Float32

from l2dgs_jax.cameras.flow import pixel_indices
from l2dgs_jax.cameras.geometry import between
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.training.flows import Flows
from l2dgs_jax.types import Camera

DISAGREEMENT = 5.0  # of the two warped frames, in medians over the picture, that voids a pixel
LEVELS = 1 / 255  # by which they may differ in any case, sRGB


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
    apart = cv2.blur(np.where(valid, np.maximum(_unlike(first, second), _unlike(second, first)), 0), (3, 3))
    valid &= apart < DISAGREEMENT * (np.median(apart[valid]) if valid.any() else 0) + LEVELS
    if split.valid is not None:
        valid &= split.valid[frame] & split.valid[other]
    nearer = first if part < 0.5 else second  # their mean would be less noisy, and less sharp
    image = np.where(valid[..., None], np.clip(nearer, 0, 1), 0).astype(np.float16)
    return View(between(split.cameras, frame, other, part), image, valid)


def _unlike(first: Float32[np.ndarray, "H W 3"], second: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    """How far colours of the first are from all that the second has within a pixel.

    Flow is not exact, and edges are steep (Birchfield and Tomasi, PAMI 1998).
    """
    around = np.ones((3, 3), np.uint8)
    least, most = cv2.erode(second, around), cv2.dilate(second, around)
    return np.maximum(np.maximum(least - first, first - most), 0).mean(-1)


def _warped(
    image: Float32[np.ndarray, "H W 3"], flow: Float32[np.ndarray, "H W 2"]
) -> tuple[Float32[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """The image seen at each pixel plus its flow, and where that is known."""
    height, width = image.shape[:2]
    at = flow + pixel_indices(height, width)
    known: np.ndarray = np.all((at >= 0) & (at <= (width - 1, height - 1)), axis=-1)  # not where flow is NaN
    at = np.where(known[..., None], at, 0)
    return cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE), known
