"""Dense matches between frames, by optical flow on brightened copies."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

BLUR = 1.0  # standard deviation in pixels of what takes noise off before matching
REMEMBERED = 48  # pairs of frames whose flow is kept
LOST = 3.0  # pixels from where flow returns to that void a match
REFINEMENTS = 10  # of smooth flow in the frames, each of so many steps


class Matches(NamedTuple):
    """A frame's matches with K others.

    Attributes:
        positions: where each pixel is found.
        errors: pixels between where a match starts and where flow from its end returns to.
    """

    positions: Float32[np.ndarray, "K H W 2"]
    errors: Float32[np.ndarray, "K H W"]


def brightened(images: Float[np.ndarray, "F H W 3"]) -> UInt8[np.ndarray, "F H W"]:
    """Grey copies for matching: noise blurred away, then one stretch of contrast for all frames."""
    sample = [_smooth_grey(images[i]) for i in range(0, len(images), max(len(images) // 16, 1))]
    low, high = np.percentile(sample, (0.5, 99.5))
    span = max(high - low, 1e-6)
    stretched = (np.clip((_smooth_grey(image) - low) / span, 0, 1) for image in images)
    return np.stack([np.round(255 * grey).astype(np.uint8) for grey in stretched])


def _smooth_grey(image: Float[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    return cv2.GaussianBlur(cv2.cvtColor(image.astype(np.float32), cv2.COLOR_RGB2GRAY), (0, 0), BLUR)


def optical_flow(
    first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"], finest_scale: int = 0
) -> Float32[np.ndarray, "H W 2"]:
    """Dense optical flow by inverse search (DIS, arXiv 1603.03590), down to pixels of 2^`finest_scale`."""
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(finest_scale)
    return search.calc(first, second, None)  # type: ignore[call-overload]


def smooth_flow(
    first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"], size: float
) -> Float32[np.ndarray, "H W 2"]:
    """Dense optical flow that follows what patches lose, as what turns or is thin, but blurs the edges of what moves.

    It minimises DeepFlow's energy (ICCV 2013, without its matches) in pictures of `size` times the frames', and is
    refined in these: the smaller, the larger are the motions that it follows, and the fewer the details.
    """
    height, width = first.shape
    small = max(round(size * width), 1), max(round(size * height), 1)
    smaller = (cv2.resize(picture, small, interpolation=cv2.INTER_AREA) for picture in (first, second))
    flow = cv2.optflow.createOptFlow_DeepFlow().calc(*smaller, None)  # type: ignore[call-overload]
    flow = cv2.resize(flow, (width, height)) * np.array([width, height], np.float32) / np.array(small, np.float32)
    refinement = cv2.VariationalRefinement.create()
    refinement.setFixedPointIterations(REFINEMENTS)
    refinement.setSorIterations(REFINEMENTS)
    return refinement.calc(first, second, flow)


def pixel_indices(height: int, width: int) -> Float32[np.ndarray, "H W 2"]:
    """Column and row of every pixel; their centres lie at +0.5."""
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return np.stack([columns, rows], axis=-1)


def match(there: Float32[np.ndarray, "H W 2"], back: Float32[np.ndarray, "H W 2"]) -> Matches:
    """Matches from flow to another view and from there back."""
    height, width = there.shape[:2]
    ends = there + pixel_indices(height, width)
    returned = cv2.remap(back, ends[..., 0], ends[..., 1], cv2.INTER_LINEAR)
    left = (ends < 0).any(-1) | (ends > (width - 1, height - 1)).any(-1)
    errors = np.where(left, np.float32(2 * LOST), np.linalg.norm(there + returned, axis=-1))
    return Matches(ends + np.float32(0.5), errors.astype(np.float32))  # pixel centres lie at +0.5


def matcher(greys: UInt8[np.ndarray, "F H W"]) -> Callable[[int, Sequence[int]], Matches]:
    """A function of a frame and others that finds its matches with them.

    Flow is kept of some pairs: in the order of time most come back, the other way round, before they are forgotten.
    """
    flow = functools.lru_cache(REMEMBERED)(lambda first, second: optical_flow(greys[first], greys[second]))

    def matches(frame: int, others: Sequence[int]) -> Matches:
        found = [match(flow(frame, other), flow(other, frame)) for other in others]
        return Matches(*map(np.stack, zip(*found, strict=True)))

    return matches
