"""Dense matches between frames, by optical flow on brightened copies."""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped, UInt8

from l2dgs_jax.errors import UserError

BLUR_SIGMA = 1.0  # standard deviation in pixels of the Gaussian that suppresses noise before matching
CACHED_FLOWS = 48  # frame pairs whose flow is kept
INVALID_REACH = 9  # side in pixels of the square around a pixel that is not valid in which flow follows its outline
LOST = 3.0  # forward-backward error in pixels from which a match counts as lost
MIN_GAIN = 0.02  # change of exposure that is worth undoing: smaller ones may be those of what moves, and do no harm
MIN_SIDES = 8, 12  # pixels, shorter and longer side of the smallest frames that `optical_flow` takes
REFINEMENT_STEPS = 10  # fixed-point iterations that refine smooth flow at full size, and SOR iterations in each


class Matches(NamedTuple):
    """A frame's matches with K others.

    Attributes:
        positions: where each pixel is found, pixel centres at +0.5.
        errors: forward-backward errors in pixels, above `LOST` for matches outside the image.
    """

    positions: Float32[np.ndarray, "K H W 2"]
    errors: Float32[np.ndarray, "K H W"]


def brightened(images: Float[np.ndarray, "F H W 3"]) -> UInt8[np.ndarray, "F H W"]:
    """Grey copies for matching: noise blurred away, then the same contrast stretch for all frames."""
    sample = [_smooth_grey(images[i]) for i in range(0, len(images), max(len(images) // 16, 1))]
    low, high = np.percentile(sample, (0.5, 99.5))
    span = max(high - low, 1e-6)
    stretched = (np.clip((_smooth_grey(image) - low) / span, 0, 1) for image in images)
    return np.stack([np.round(255 * grey).astype(np.uint8) for grey in stretched])


def _smooth_grey(image: Float[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    return cv2.GaussianBlur(cv2.cvtColor(image.astype(np.float32), cv2.COLOR_RGB2GRAY), (0, 0), BLUR_SIGMA)


def optical_flow(
    first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"], finest_scale: int = 0
) -> Float32[np.ndarray, "H W 2"]:
    """Dense optical flow by inverse search (DIS, arXiv 1603.03590), down to a scale of 1 / 2^`finest_scale`.

    Raises:
        UserError: the frames are too small.
    """
    check_size(*first.shape)
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(finest_scale)
    return search.calc(first, second, None)  # type: ignore[call-overload]


def check_size(height: int, width: int) -> None:
    """Refuses frames that are too small for `optical_flow`.

    Raises:
        UserError: a side is shorter than its entry of `MIN_SIDES`.
    """
    if min(height, width) < MIN_SIDES[0] or max(height, width) < MIN_SIDES[1]:
        raise UserError(
            f"frames of {width}x{height} pixels are too small for optical flow; "
            f"expected sides of at least {MIN_SIDES[0]} and {MIN_SIDES[1]} pixels"
        )


def smooth_flow(
    first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"], size: float
) -> Float32[np.ndarray, "H W 2"]:
    """Dense variational flow: follows what patches (`optical_flow`) lose, such as rotating or thin things.

    Its motion boundaries are blurred, though. It minimises the energy of DeepFlow (ICCV 2013, without its descriptor
    matching) on frames scaled by `size`, and is then refined at full size: the smaller `size`, the larger the motions
    that it follows and the fewer the details.
    """
    height, width = first.shape
    small = max(round(size * width), 1), max(round(size * height), 1)
    smaller = (cv2.resize(picture, small, interpolation=cv2.INTER_AREA) for picture in (first, second))
    flow = cv2.optflow.createOptFlow_DeepFlow().calc(*smaller, None)  # type: ignore[call-overload]
    flow = cv2.resize(flow, (width, height)) * np.array([width, height], np.float32) / np.array(small, np.float32)
    return refined(first, second, flow)


def refined(
    first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"], flow: Float32[np.ndarray, "H W 2"]
) -> Float32[np.ndarray, "H W 2"]:
    """The flow after variational refinement, which corrects errors of about a pixel."""
    refinement = cv2.VariationalRefinement.create()
    refinement.setFixedPointIterations(REFINEMENT_STEPS)
    refinement.setSorIterations(REFINEMENT_STEPS)
    return refinement.calc(first, second, flow.copy())  # it overwrites its argument


def equally_exposed(first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
    """The second frame as bright as the first.

    Patches are normalised when they are compared, so that optical flow does not depend on exposure; but whatever
    compares the frames after it does.
    """
    gain = relative_gain(first, warped(second, optical_flow(first, second)))
    return second if gain == 1 else np.clip(np.round(gain * second), 0, 255).astype(np.uint8)


def relative_gain(first: Shaped[np.ndarray, "*S"], second: Shaped[np.ndarray, "*S"]) -> float:
    """How much brighter the first of two pictures of the same things is; 1 if it is hardly brighter or darker.

    Pixels that are 0 in one of them, as outside the picture, do not count; few that show different things do no harm.
    """
    known = (first > 0) & (second > 0)
    gain = np.median(first[known] / second[known]) if known.any() else 1.0
    return float(gain) if abs(gain - 1) > MIN_GAIN else 1.0


def surely_valid(valid: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """The valid pixels that have none beside them that is not."""
    return cv2.erode(valid.astype(np.uint8), np.ones((INVALID_REACH, INVALID_REACH), np.uint8)) > 0


def warped(image: UInt8[np.ndarray, "H W"], flow: Float32[np.ndarray, "H W 2"]) -> Float32[np.ndarray, "H W"]:
    """The image sampled at each pixel plus its flow."""
    at = flow + pixel_indices(*image.shape)
    return cv2.remap(image.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR)


def pixel_indices(height: int, width: int) -> Float32[np.ndarray, "H W 2"]:
    """Column and row of every pixel; their centres lie at +0.5."""
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return np.stack([columns, rows], axis=-1)


def match(forward: Float32[np.ndarray, "H W 2"], backward: Float32[np.ndarray, "H W 2"]) -> Matches:
    """Matches from the flow to another view and the flow back from there."""
    height, width = forward.shape[:2]
    ends = forward + pixel_indices(height, width)
    returned = cv2.remap(backward, ends[..., 0], ends[..., 1], cv2.INTER_LINEAR)
    outside = (ends < 0).any(-1) | (ends > (width - 1, height - 1)).any(-1)
    errors = np.where(outside, np.float32(2 * LOST), np.linalg.norm(forward + returned, axis=-1))
    return Matches(ends + np.float32(0.5), errors.astype(np.float32))  # pixel centres lie at +0.5


def matcher(greys: UInt8[np.ndarray, "F H W"]) -> Callable[[int, Sequence[int]], Matches]:
    """A function of a frame and others that finds its matches with them.

    Recent flows are cached: if frames are visited in order of time, most pairs are asked for again, with the roles of
    their frames swapped, before they are evicted.
    """
    flow = functools.lru_cache(CACHED_FLOWS)(lambda first, second: optical_flow(greys[first], greys[second]))

    def matches(frame: int, others: Sequence[int]) -> Matches:
        found = [match(flow(frame, other), flow(other, frame)) for other in others]
        return Matches(*map(np.stack, zip(*found, strict=True)))

    return matches
