"""Brighter copies of dark frames for finding features; the frames to train on stay unchanged."""

from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from l2dgs_jax.data.color import brightening_exponent
from l2dgs_jax.preprocess.capture.frames import luma

TARGET_MEAN = 0.4  # of the brightened copies
LARGEST_GAIN = 25.0
SMALLEST_EXPONENT = 0.5
NOISY_BELOW = 0.25  # mean level of frames below which their noise is smoothed
SMOOTHING = 0.8  # standard deviation, pixels


class Tone(NamedTuple):
    """How the frames of a clip are brightened: blur, then min(1, gain * luma) ** exponent.

    Attributes:
        gain: at least 1.
        exponent: at most 1.
        smoothing: standard deviation of the blur in pixels; 0 for none.
    """

    gain: float
    exponent: float
    smoothing: float


def tone_for(frames: Iterable[Float32[np.ndarray, "H W 3"]]) -> Tone:
    """One curve for the whole clip, so that its frames stay comparable with each other.

    The gain brings the brightest hundredth of the median frame to white, the exponent its mean to `TARGET_MEAN`.
    """
    greys = (luma(frame[::4, ::4]) for frame in frames)
    levels = [(float(np.quantile(grey, 0.99)), float(grey.mean())) for grey in greys]
    high, mean = np.median(levels, axis=0).tolist()
    gain = float(np.clip(0.95 / max(high, 1e-3), 1, LARGEST_GAIN))
    exponent = brightening_exponent(gain * mean, TARGET_MEAN)
    return Tone(gain, max(exponent, SMALLEST_EXPONENT), SMOOTHING if mean < NOISY_BELOW else 0.0)


def brighten(image: Float32[np.ndarray, "H W 3"], tone: Tone) -> UInt8[np.ndarray, "H W"]:
    """The brightened grey copy of a frame, of the same size."""
    grey = luma(image)
    if tone.smoothing:
        grey = cv2.GaussianBlur(grey, (0, 0), tone.smoothing)
    curve = np.clip(tone.gain * grey, 0, 1) ** np.float32(tone.exponent)
    return np.rint(255 * curve).astype(np.uint8)
