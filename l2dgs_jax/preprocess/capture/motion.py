"""Detecting motion in a clip without known poses: optical flow against the epipolar geometry of neighbouring frames.

Between two frames of a moving camera, static surfaces at any depth move along epipolar lines; the Sampson distance from
these (Hartley and Zisserman, Multiple View Geometry, section 11.4.3) reveals what does not. Objects that move along
their own epipolar lines cannot be distinguished from static ones in this way.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from l2dgs_jax.cameras.flow import match, optical_flow
from l2dgs_jax.data.stacks import evenly_spread
from l2dgs_jax.preprocess.capture.frames import shrink

WORKING_SIZE = 512  # longer side of the pictures on which flow is computed, pixels
NEIGHBOURS = (2, 4)  # distances to the earlier and later frames with which each frame is compared
TOLERANCE = 1.5  # pixels from the epipolar line
MOVING_VOTES = 0.3  # share of the comparisons showing a pixel that must find it off the epipolar line
LARGEST_MASK = 0.6  # share of the picture; if a mask covers more, the geometry is taken to be wrong
STILL_BELOW = 1.0  # pixels of flow, below which the camera counts as still: no parallax could be measured

_SPACING = 4  # pixels between the positions that the geometry is fitted to
_FEWEST_POSITIONS = 50  # for a fit
_CONSISTENT = 1.0  # pixels from its start within which forward and backward flow must end


def small(picture: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "h w"]:
    """A picture at the size that flow is computed on, smoothed against noise."""
    return cv2.GaussianBlur(shrink(picture, WORKING_SIZE), (0, 0), 1.0)


def moving_regions(pictures: Sequence[UInt8[np.ndarray, "h w"]]) -> Iterator[Bool[np.ndarray, "h w"]]:
    """For each picture, where something moves, with a margin; nowhere if no geometry explains the flow.

    Args:
        pictures: a clip in order of time, as `small` gives them.
    """
    votes = {i: np.zeros((2, *picture.shape), np.uint8) for i, picture in enumerate(pictures)}
    for i in range(len(pictures)):
        for j in (i + offset for offset in NEIGHBOURS if i + offset < len(pictures)):
            for k, distance in zip((i, j), _distances_to_epipolar_lines(pictures[i], pictures[j]), strict=True):
                votes[k] += np.stack([distance > TOLERANCE, ~np.isnan(distance)])  # NaN exceeds nothing
        off, seen = votes.pop(i)
        mask = ((off > 0) & (off >= MOVING_VOTES * seen)).astype(np.uint8)
        mask = cv2.dilate(cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((5, 5))), np.ones((9, 9)))
        yield np.zeros(mask.shape, bool) if mask.mean() > LARGEST_MASK else mask > 0


def camera_shift(pictures: Sequence[UInt8[np.ndarray, "h w"]], samples: int = 5) -> float:
    """How far the picture as a whole moves: the largest median flow between any two of a few pictures, in pixels.

    The median ignores objects that move in front of a background that fills most of the picture.
    """
    chosen = [pictures[i] for i in evenly_spread(len(pictures), samples)]
    pairs = ((a, b) for i, a in enumerate(chosen) for b in chosen[i + 1 :])
    return max((float(np.median(np.linalg.norm(_flow(a, b)[_textured(a)], axis=-1))) for a, b in pairs), default=0.0)


def _distances_to_epipolar_lines(
    first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Sampson distances of the flow from each picture to the other, pixels; NaN where the flow cannot be trusted."""
    there, back = _flow(first, second), _flow(second, first)
    forth, returned = match(there, back), match(back, there)
    here = forth.positions - there
    trusted, trusted_back = forth.errors < _CONSISTENT, returned.errors < _CONSISTENT

    grid = (slice(_SPACING // 2, None, _SPACING),) * 2
    usable = (trusted & _textured(first))[grid]
    distance, distance_back = np.full((2, *first.shape), np.nan)
    if usable.sum() < _FEWEST_POSITIONS:
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
    return optical_flow(first, second, finest_scale=1)  # three times as fast, and accurate enough here


def _textured(picture: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where there is texture for flow to match: the 70 % of the picture with most."""
    strength = cv2.cornerMinEigenVal(picture, 7)
    return strength >= np.quantile(strength, 0.3)
