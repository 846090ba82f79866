"""Optical flow of what moves too far from frame to frame to be found from coarse to fine.

A search from coarse to fine starts from small copies of the frames, in which a small thing that moves by more than its
own size is lost: it is taken to move like the background. Here, patches of what is lost are looked for everywhere
around, as other methods look for descriptors (LDOF, PAMI 2011; DeepFlow, ICCV 2013).
"""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from l2dgs_jax.cameras.flow import refined, warped

LONGEST_SIDE = 240  # pixels of the copies in which patches are looked for; the lengths below are in their pixels
PATCH = 13  # side of a patch
STRIDE = 4  # distance between patches
RADIUS = 40  # along x and y, within which a patch is looked for
MIN_LOST = 0.4  # share of a patch that is lost
MIN_CONTRAST = 6.0  # standard deviation of a patch, grey levels
MIN_CORRELATION = 0.6
MAX_RETURN = 1  # along x and y, by which the search back from a match may miss the patch
MAX_OVER_MEDIAN, MARGIN = 6.0, 8.0  # residuals above this many medians plus so many grey levels are not explained


class _Jump(NamedTuple):
    row: int
    column: int
    down: int
    right: int
    correlation: float


def unexplained(
    first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"], flow: Float32[np.ndarray, "H W 2"]
) -> Bool[np.ndarray, "H W"]:
    """Where the second frame, warped by the flow to it, does not look like the first, or the flow is NaN."""
    known = np.isfinite(flow[..., 0])
    residuals = cv2.blur(_residuals(first, second, np.nan_to_num(flow)), (3, 3))
    typical = np.median(residuals[known]) if known.any() else 0
    return ~known | (residuals > MAX_OVER_MEDIAN * typical + MARGIN)


def follow_jumps(
    first: UInt8[np.ndarray, "H W"],
    second: UInt8[np.ndarray, "H W"],
    flow: Float32[np.ndarray, "H W 2"],
    lost: Bool[np.ndarray, "H W"],
    shortest: float,
) -> tuple[Float32[np.ndarray, "H W 2"], Bool[np.ndarray, "H W"]]:
    """The flow to the second frame with jumps, and where there are any: where patches were found that explain more.

    Args:
        first: brightened frame.
        second: brightened frame.
        flow: to the second frame, from a search from coarse to fine.
        lost: where it is not to be trusted.
        shortest: how far from where `flow` takes it a patch must be found, pixels of frames whose longest side is
            `LONGEST_SIDE` or less.
    """
    height, width = first.shape
    scale = min(LONGEST_SIDE / max(height, width), 1.0)
    size = max(round(scale * width), 1), max(round(scale * height), 1)
    factor = np.array(size, np.float32) / np.array([width, height], np.float32)
    one, other = (cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in (first, second))
    lost = cv2.resize(lost.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5

    slow = factor * cv2.resize(flow, size)
    fast, correlations = slow.copy(), np.full(lost.shape, MIN_CORRELATION)
    for jump in _jumps(one, other, lost):
        patch = np.s_[jump.row : jump.row + PATCH, jump.column : jump.column + PATCH]
        better = jump.correlation > correlations[patch]
        correlations[patch][better] = jump.correlation
        fast[patch][better] = jump.right, jump.down
    unlike = [cv2.blur(_residuals(one, other, candidate), (PATCH, PATCH)) for candidate in (slow, fast)]
    jumps = (correlations > MIN_CORRELATION) & (np.linalg.norm(fast - slow, axis=-1) >= shortest)
    jumps &= lost | (unlike[1] < unlike[0])

    found = refined(one, other, np.where(jumps[..., None], fast, slow))
    if scale < 1:
        found = refined(first, second, cv2.resize(found, (width, height)) / factor)
        jumps = cv2.resize(jumps.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    return found, jumps


def _residuals(
    first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"], flow: Float32[np.ndarray, "H W 2"]
) -> Float32[np.ndarray, "H W"]:
    return np.abs(first - warped(second, flow))


def _jumps(
    first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"], lost: Bool[np.ndarray, "h w"]
) -> Iterator[_Jump]:
    """The lost patches that are found in the second frame, and found again from there."""
    height, width = first.shape
    if min(height, width) < PATCH:
        return
    share = cv2.blur(lost.astype(np.float32), (PATCH, PATCH), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    inside = share[: height - PATCH + 1 : STRIDE, : width - PATCH + 1 : STRIDE]
    for row, column in (STRIDE * np.argwhere(inside >= MIN_LOST)).tolist():
        match = _best_match(first, second, row, column)
        if match is None:
            continue
        there, correlation = match
        back = _best_match(second, first, *there)
        if back is not None and max(abs(back[0][0] - row), abs(back[0][1] - column)) <= MAX_RETURN:
            yield _Jump(row, column, there[0] - row, there[1] - column, correlation)


def _best_match(
    first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"], row: int, column: int
) -> tuple[tuple[int, int], float] | None:
    """Row and column of what is most like a patch of the first frame, and its correlation; None if nothing is."""
    patch = first[row : row + PATCH, column : column + PATCH]
    if patch.std() < MIN_CONTRAST:
        return None
    top, left = max(row - RADIUS, 0), max(column - RADIUS, 0)
    around = second[top : row + RADIUS + PATCH, left : column + RADIUS + PATCH]
    _, correlation, _, (x, y) = cv2.minMaxLoc(cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED))
    return ((top + y, left + x), correlation) if correlation > MIN_CORRELATION else None
