"""What the frames show at the points: colours to start from, and how the camera's exposure changed."""

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float

from l2dgs_jax.cameras.geometry import points_inside
from l2dgs_jax.data.stacks import MappedArray, nan_median, pixel_mean, stacked
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera

VALUES_IN_MEMORY = 2**26  # observed colour values that are held in memory at once, at most
MIN_VALUE = 2 / 255  # sRGB; darker values are raised to it, as ratios of them tell little
ALTERNATIONS = 3  # between gains given the points' colours and colours given the gains
MAX_POINTS = 5000  # that gains are estimated from
# A point counts as hidden if a share of those in its cell of the frame, more than the few that structure from motion
# misplaces, is nearer by more than a factor.
CELL, HIDING_SHARE, HIDING = 1 / 14, 0.25, 1.2  # side of a cell over the frame's height


def observed_colors(
    points: Float[np.ndarray, "P 3"],
    cameras: Camera,
    images: Float[np.ndarray, "F H W 3"],
    valid: Bool[np.ndarray, "F H W"] | None = None,
) -> Float[np.ndarray, "P 3"]:
    """Median colour of the pixels that each point projects to, occlusion ignored; the images' mean if there are none.

    Memory is bounded whatever the numbers of frames and points: large sets of colours lie in a temporary file.

    Args:
        points: world units.
        cameras: F cameras.
        images: their images, sRGB in [0, 1].
        valid: which pixels count; None for all.
    """
    shape = (len(images), len(points), 3)
    frames = prefetch(lambda i: _observed(points, cameras, images, valid, i), range(len(images)))
    seen = stacked(frames, shape, images.dtype, in_file=math.prod(shape) > VALUES_IN_MEMORY)
    chunk = max(VALUES_IN_MEMORY // (3 * len(images)), 1)
    parts = [nan_median(seen[:, i : i + chunk].astype(np.float32)) for i in range(0, max(len(points), 1), chunk)]
    colors = np.concatenate(parts)
    unseen = np.isnan(colors).all(-1)
    if unseen.any():
        colors[unseen] = pixel_mean(images, valid)
    return colors


def exposures(
    points: Float[np.ndarray, "P 3"],
    cameras: Camera,
    images: Float[np.ndarray, "F H W 3"],
    valid: Bool[np.ndarray, "F H W"] | None = None,
) -> Float[np.ndarray, "F 3"]:
    """Log gains of the frames' colour channels, of mean 0 over the frames.

    A frame's gain is the median, over the points, of how much brighter they are there than in the median over the
    frames. Points that others hide do not count; those that move or are specular do no harm as long as they are few.

    Args:
        points: world units.
        cameras: F cameras.
        images: their images, sRGB in [0, 1].
        valid: which pixels count; None for all.
    """
    points = points[:: -(-len(points) // MAX_POINTS)]

    def unhidden(frame: int) -> Float[np.ndarray, "P 3"]:
        colors = _observed(points, cameras, images, valid, frame, blur=True)
        colors[_hidden(points, cameras, frame, images.shape[1:3])] = np.nan
        return colors

    frames = prefetch(unhidden, range(len(images)))
    seen = np.log(np.maximum(np.stack([*frames]).astype(np.float32), MIN_VALUE))
    gains = np.zeros((len(images), 1, 3), np.float32)
    for _ in range(ALTERNATIONS):
        gains = np.nan_to_num(nan_median((seen - nan_median(seen - gains)).swapaxes(0, 1)))[:, None]
        gains -= gains.mean(0)
    return gains[:, 0]


def evenly_exposed(images: Float[np.ndarray, "F H W 3"], log_gains: Float[np.ndarray, "F 3"]) -> np.ndarray:
    """The images as if none had another exposure than the rest: divided by gains as `exposures` finds them."""
    frames = (image / np.exp(gain) for image, gain in zip(images, log_gains, strict=True))
    return stacked(frames, images.shape, images.dtype, in_file=isinstance(images, MappedArray))


def _observed(
    points: Float[np.ndarray, "P 3"],
    cameras: Camera,
    images: Float[np.ndarray, "F H W 3"],
    valid: Bool[np.ndarray, "F H W"] | None,
    frame: int,
    blur: bool = False,
) -> Float[np.ndarray, "P 3"]:
    """Colours at the points in a frame, with `blur` means over 3x3 pixels; NaN where no valid pixel shows them."""
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


def _hidden(
    points: Float[np.ndarray, "P 3"], cameras: Camera, frame: int, size: tuple[int, ...]
) -> Bool[np.ndarray, " P"]:
    """Which points lie behind others in a frame of that height and width."""
    viewmat, K = np.asarray(cameras.viewmat[frame]), np.asarray(cameras.K[frame])
    inside, pixels, depth = points_inside(points, viewmat, K, size[::-1])
    column, row = (pixels // (CELL * size[0])).astype(int).T
    _, cell, counts = np.unique(row * size[1] + column, return_inverse=True, return_counts=True)
    rank = np.cumsum(counts) - counts + (HIDING_SHARE * (counts - 1)).astype(int)
    front = depth[np.lexsort((depth, cell))][rank]
    hidden = np.zeros(len(points), bool)
    hidden[inside] = depth > HIDING * front[cell]
    return hidden
