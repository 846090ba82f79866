"""What the frames show at the points: colours to start from, and how the camera's exposure changed."""

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float

from l2dgs_jax.cameras.geometry import points_inside
from l2dgs_jax.data.stacks import pixel_mean, stacked
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera

SEEN_AT_ONCE = 2**26  # colour values of points that are held in memory
DARKEST = 2 / 255  # sRGB value below which ratios tell little
ROUNDS = 3  # of exposures from colours and colours from exposures
LOOKED_AT = 5000  # points that exposures are taken from, at most


def observed_colors(
    points: Float[np.ndarray, "P 3"],
    cameras: Camera,
    images: Float[np.ndarray, "F H W 3"],
    valid: Bool[np.ndarray, "F H W"] | None = None,
) -> Float[np.ndarray, "P 3"]:
    """Median colour of the pixels that each point projects to, occlusion ignored; the mean where none are.

    Memory is bounded whatever the numbers of frames and points: colours that take much lie in a temporary file.

    Args:
        points: world units.
        cameras: F cameras.
        images: their images, sRGB in [0, 1].
        valid: which pixels count; None for all.
    """
    shape = (len(images), len(points), 3)
    frames = prefetch(lambda i: _seen(points, cameras, images, valid, i), range(len(images)))
    seen = stacked(frames, shape, images.dtype, in_file=math.prod(shape) > SEEN_AT_ONCE)
    some = max(SEEN_AT_ONCE // (3 * len(images)), 1)
    parts = [_median(seen[:, start : start + some].astype(np.float32)) for start in range(0, len(points), some)]
    colors = np.concatenate(parts)
    return np.where(np.isnan(colors).all(-1, keepdims=True), pixel_mean(images, valid).astype(colors.dtype), colors)


def exposures(
    points: Float[np.ndarray, "P 3"],
    cameras: Camera,
    images: Float[np.ndarray, "F H W 3"],
    valid: Bool[np.ndarray, "F H W"] | None = None,
) -> Float[np.ndarray, "F 3"]:
    """Logarithms of the gains of the frames' channels, of mean 0: what most points say.

    A frame's gain is the median, over the points, of how much brighter they are there than they usually are. Points
    that move, are hidden or shine are outvoted as long as they are few.

    Args:
        points: world units.
        cameras: F cameras.
        images: their images, sRGB in [0, 1].
        valid: which pixels count; None for all.
    """
    points = points[:: -(-len(points) // LOOKED_AT)]
    frames = prefetch(lambda i: _seen(points, cameras, images, valid, i, blur=True), range(len(images)))
    seen = np.log(np.maximum(np.stack([*frames]).astype(np.float32), DARKEST))
    gains = np.zeros((len(images), 1, 3), np.float32)
    for _ in range(ROUNDS):
        gains = np.nan_to_num(_median((seen - _median(seen - gains)).swapaxes(0, 1)))[:, None]
        gains -= gains.mean(0)
    return gains[:, 0]


def _seen(
    points: Float[np.ndarray, "P 3"],
    cameras: Camera,
    images: Float[np.ndarray, "F H W 3"],
    valid: Bool[np.ndarray, "F H W"] | None,
    frame: int,
    blur: bool = False,
) -> Float[np.ndarray, "P 3"]:
    """Colours of the points in a frame, or of the 3x3 pixels around them; NaN where they are not to be seen."""
    viewmat, K, image = np.asarray(cameras.viewmat[frame]), cameras.K[frame], images[frame]
    if blur:
        image = cv2.blur(image.astype(np.float32), (3, 3))
    inside, pixels, _ = points_inside(points, viewmat, np.asarray(K), image.shape[1::-1])
    column, row = pixels.astype(int).T
    colors = np.full((len(points), 3), np.nan, image.dtype)
    colors[inside] = image[row, column]
    if valid is not None:
        colors[np.flatnonzero(inside)[~valid[frame][row, column]]] = np.nan
    return colors


def _median(seen: Float[np.ndarray, "F P 3"]) -> Float[np.ndarray, "P 3"]:
    """Median over the first axis, without values that are NaN."""
    last = np.count_nonzero(~np.isnan(seen), axis=0, keepdims=True) - 1
    seen = np.sort(seen, axis=0)  # NaN last
    return np.take_along_axis(seen, np.concatenate([last // 2, (last + 1) // 2]), axis=0).mean(0)
