"""Frames with less noise to learn from: each is averaged with what its neighbours show of the same points.

The noise of a dark frame is as large as many details in it. A scene that learns from few frames for long fits it, and
looks wrong from other viewpoints. Neighbouring frames show nearly the same with other noise.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.stacks import MappedArray, stacked
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.training.flows import Flows, concatenated, warped

REACH = 2  # frames before and after that a frame is averaged with
WINDOW = 3  # side in pixels of the squares in which frames are compared
CAUTION = 2.0  # factor on the squared errors of neighbours that such a comparison finds

Way = dict[int, tuple[int, tuple[int, int]]]  # from a frame to its neighbour, and where in `Flows` the flow to it is


def denoised(split: Split, flows: Flows) -> Split:
    """The frames with less noise; what no neighbour shows where flow says it does stays as it is.

    Args:
        split: the frames.
        flows: optical flow between them.
    """
    images = split.images
    pairs = [(first, second) for first, second in enumerate(flows.following.tolist()) if first != second]
    ahead = {first: (second, (first, 0)) for first, second in pairs}
    back = {second: (first, (first, 1)) for first, second in pairs}
    frames = prefetch(lambda frame: _denoised(split, flows, (ahead, back), frame), range(len(images)))
    clean = stacked(frames, images.shape, images.dtype, in_file=isinstance(images, MappedArray))
    return dataclasses.replace(split, images=clean)


def _denoised(split: Split, flows: Flows, ways: Sequence[Way], frame: int) -> Float32[np.ndarray, "H W 3"]:
    own = split.images[frame].astype(np.float32)
    total, weights = own.copy(), np.ones(own.shape[:2], np.float32)
    for neighbour, flow in (end for way in ways for end in _reached(flows, way, frame)):
        shown, known = warped(split, neighbour, flow)
        weight = _weight(own, shown, known)
        total += weight[..., None] * np.where(known[..., None], shown, 0)
        weights += weight
    return np.clip(total / weights[..., None], 0, 1)


def _reached(flows: Flows, way: Way, frame: int) -> Iterator[tuple[int, Float32[np.ndarray, "H W 2"]]]:
    """The next `REACH` frames on the way, as far as it goes, and the flow to each."""
    flow = None
    for _ in range(REACH):
        if frame not in way:
            return
        frame, place = way[frame]
        step = flows.displacements[place].astype(np.float32)
        flow = step if flow is None else concatenated(flow, step)
        yield frame, flow


def _weight(
    own: Float32[np.ndarray, "H W 3"], shown: Float32[np.ndarray, "H W 3"], known: Bool[np.ndarray, "H W"]
) -> Float32[np.ndarray, "H W"]:
    """The weight of a neighbour's pixels where one's own have 1: the ratio of the variances.

    Most of the frame shows the same as its neighbour except for noise. So the median of their squared difference is
    twice the variance of noise, and what exceeds it is the neighbour's squared error.
    """
    share = cv2.blur(known.astype(np.float32), (WINDOW, WINDOW))
    squares = np.where(known, np.square(own - shown).mean(-1), 0)
    difference = cv2.blur(squares, (WINDOW, WINDOW))[known] / share[known]
    usual = max(np.median(difference), 1e-12) if known.any() else 1.0
    weight = np.zeros(known.shape, np.float32)
    weight[known] = 1 / (1 + 2 * CAUTION * np.maximum(difference / usual - 1, 0))
    return weight
