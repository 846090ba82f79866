"""What moves in a clip whose poses are not known yet: optical flow against the epipolar geometry of neighbours.

Static surfaces, however deep, move along epipolar lines between two frames of a moving camera; the Sampson distance to
them (Hartley and Zisserman, Multiple View Geometry, section 11.4.3) shows what does not. What moves along its own
epipolar lines cannot be told from what stands still this way.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from l2dgs_jax.cameras.flow import match, optical_flow
from l2dgs_jax.preprocess.capture.frames import shrink

WORKING_SIZE = 512  # longer side of the pictures that flow is computed on, pixels
NEIGHBOURS = (2, 4)  # how many frames before and after each one those are that it is compared with
TOLERANCE = 1.5  # pixels off the epipolar line
VOTES = 0.3  # of the comparisons in which a pixel is seen must find it off the line
LARGEST = 0.6  # a mask that covers more of the picture is a geometry that was not found
STILL = 1.0  # pixels of flow under which no parallax could be measured

_SPACING = 4  # pixels between the positions that the geometry is fitted to
_FEWEST = 50  # such positions
_CONSISTENT = 1.0  # pixels between a place and where flow forth and back leads


def small(picture: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "h w"]:
    """A picture at the size that flow is computed on, smoothed against noise."""
    return cv2.GaussianBlur(shrink(picture, WORKING_SIZE), (0, 0), 1.0)


def moving_regions(pictures: Sequence[UInt8[np.ndarray, "h w"]]) -> Iterator[Bool[np.ndarray, "h w"]]:
    """For each picture where something moves, with a margin; nowhere if no geometry explains the flow.

    Args:
        pictures: a clip in order of time, as `small` gives them.
    """
    votes = {i: np.zeros((2, *picture.shape), np.uint8) for i, picture in enumerate(pictures)}
    for i in range(len(pictures)):
        for j in (i + offset for offset in NEIGHBOURS if i + offset < len(pictures)):
            for k, distance in zip((i, j), _distances_to_epipolar_lines(pictures[i], pictures[j]), strict=True):
                votes[k] += np.stack([distance > TOLERANCE, ~np.isnan(distance)])  # NaN exceeds nothing
        off, seen = votes.pop(i)
        mask = ((off > 0) & (off >= VOTES * seen)).astype(np.uint8)
        mask = cv2.dilate(cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((5, 5))), np.ones((9, 9)))
        yield np.zeros(mask.shape, bool) if mask.mean() > LARGEST else mask > 0


def camera_shift(pictures: Sequence[UInt8[np.ndarray, "h w"]], samples: int = 5) -> float:
    """How far the picture as a whole moves: the largest median flow between any two of a few pictures, in pixels.

    The median ignores objects that move before a background that fills most of the picture.
    """
    chosen = [pictures[i] for i in np.unique(np.linspace(0, len(pictures) - 1, samples).round().astype(int))]
    pairs = ((a, b) for i, a in enumerate(chosen) for b in chosen[i + 1 :])
    return max((float(np.median(np.linalg.norm(_flow(a, b)[_textured(a)], axis=-1))) for a, b in pairs), default=0.0)


def _distances_to_epipolar_lines(
    first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Sampson distance in pixels of the flow from each picture to the other; NaN where it is not to be trusted."""
    there, back = _flow(first, second), _flow(second, first)
    forth, returned = match(there, back), match(back, there)
    here = forth.positions - there
    trusted, trusted_back = forth.errors < _CONSISTENT, returned.errors < _CONSISTENT

    grid = (slice(_SPACING // 2, None, _SPACING),) * 2
    usable = (trusted & _textured(first))[grid]
    distance, distance_back = np.full((2, *first.shape), np.nan)
    if usable.sum() < _FEWEST:
        return distance, distance_back
    cv2.setRNGSeed(0)
    F, _ = cv2.findFundamentalMat(here[grid][usable], forth.positions[grid][usable], cv2.USAC_MAGSAC, 0.5, 0.999, 5000)
    if F is not None and F.shape == (3, 3):
        distance[trusted] = _sampson(F, here[trusted], forth.positions[trusted])
        distance_back[trusted_back] = _sampson(F, returned.positions[trusted_back], here[trusted_back])
    return distance, distance_back


def _sampson(
    F: Float[np.ndarray, "3 3"], p: Float32[np.ndarray, "P 2"], q: Float32[np.ndarray, "P 2"]
) -> Float[np.ndarray, " P"]:
    lines = p @ F[:, :2].T + F[:, 2]
    back = q @ F[:2] + F[2]
    algebraic = (lines[:, :2] * q).sum(-1) + lines[:, 2]
    gradient = np.square(lines[:, :2]).sum(-1) + np.square(back[:, :2]).sum(-1)
    return np.abs(algebraic) / np.sqrt(np.maximum(gradient, 1e-12))


def _flow(first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 2"]:
    return optical_flow(first, second, finest_scale=1)  # three times as fast, and no more is needed here


def _textured(picture: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where flow has something to hold on to: the better 70 % of the picture."""
    strength = cv2.cornerMinEigenVal(picture, 7)
    return strength >= np.quantile(strength, 0.3)
