"""FLIP: how different two images look to a viewer who alternates between them on a screen.

Source: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images" (HPG 2020), the low dynamic range form.
"""

import math

import cv2
import numpy as np
from jaxtyping import Float, Float32

from l2dgs_jax.data.color import srgb_to_linear

PIXELS_PER_DEGREE = np.pi * 3840 / 180  # a screen 0.7 m and 3840 pixels wide, seen from 0.7 m: about 67

# Contrast sensitivity of the achromatic, red-green and blue-yellow channels: sums of Gaussians (weight, spread).
_SENSITIVITIES = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
_WIDEST = 0.04
_FEATURE_WIDTH = 0.082  # degrees
_COLOR_POWER, _FEATURE_POWER = 0.7, 0.5
_KNEE, _AT_KNEE = 0.4, 0.95  # that part of the largest colour difference is mapped to that error
_TO_XYZ = np.array(  # from linear sRGB; exact fractions, derived from its primaries and D65
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ],
    np.float32,
)
_WHITE = _TO_XYZ.sum(1)
_FROM_XYZ = np.linalg.inv(_TO_XYZ)

Pixels = Float32[np.ndarray, "*S 3"]


def flip_map(prediction: Float[np.ndarray, "H W 3"], truth: Float[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    """The perceived difference at each pixel, in [0, 1], for a screen of `PIXELS_PER_DEGREE`.

    Args:
        prediction: sRGB values in [0, 1].
        truth: sRGB values in [0, 1].
    """
    opponents = [_opponents(srgb_to_linear(np.asarray(image, np.float32))) for image in (prediction, truth)]
    return _color_error(*opponents) ** (1 - _feature_error(*opponents))


def _color_error(*opponents: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    """HyAB distance of the images as the eye resolves them, remapped so that small differences count most."""
    first, second = (_hunt_lab(np.clip(_from_opponents(_blurred(image)), 0, 1)) for image in opponents)
    green, blue = _hunt_lab(np.eye(3, dtype=np.float32)[1:])[:, None]  # the two colours that differ most
    largest = _hyab(green, blue).item()
    error, knee = _hyab(first, second) ** _COLOR_POWER, _KNEE * largest**_COLOR_POWER
    beyond = (error - knee) / (largest**_COLOR_POWER - knee)
    return np.where(error < knee, _AT_KNEE * error / knee, _AT_KNEE + (1 - _AT_KNEE) * beyond)


def _feature_error(*opponents: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    """Difference in the strength of edges or of points, whichever is larger."""
    deviation = 0.5 * _FEATURE_WIDTH * PIXELS_PER_DEGREE
    x, y = _offsets(int(np.ceil(3 * deviation)))
    gaussian = np.exp(-(x**2 + y**2) / (2 * deviation**2))
    strengths = []
    for kernel in (-x * gaussian, (x**2 / deviation**2 - 1) * gaussian):
        kernel = np.where(kernel > 0, kernel / kernel[kernel > 0].sum(), -kernel / kernel[kernel < 0].sum())
        grey = [(image[..., 0] + 16) / 116 for image in opponents]
        strengths.append([np.hypot(_filtered(image, kernel), _filtered(image, kernel.T)) for image in grey])
    differences = [np.abs(first - second) for first, second in strengths]
    return (np.maximum(*differences) / math.sqrt(2)) ** _FEATURE_POWER


def _blurred(opponents: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W 3"]:
    """The image's three channels after the eye's contrast sensitivity at the viewing distance."""
    x, y = _offsets(int(np.ceil(3 * np.sqrt(_WIDEST / (2 * np.pi**2)) * PIXELS_PER_DEGREE)))
    square = (x**2 + y**2) / PIXELS_PER_DEGREE**2
    channels = []
    for channel, terms in zip(np.moveaxis(opponents, -1, 0), _SENSITIVITIES, strict=True):
        kernel = sum(a * np.sqrt(np.pi / b) * np.exp(-(np.pi**2) * square / b) for a, b in terms)
        channels.append(_filtered(channel, kernel / np.sum(kernel)))
    return np.stack(channels, -1)


def _filtered(channel: Float32[np.ndarray, "H W"], kernel: Float[np.ndarray, "k k"]) -> Float32[np.ndarray, "H W"]:
    return cv2.filter2D(channel, -1, kernel, borderType=cv2.BORDER_REPLICATE)


def _offsets(radius: int) -> tuple[Float[np.ndarray, "1 k"], Float[np.ndarray, "k 1"]]:
    line = np.arange(-radius, radius + 1, dtype=np.float64)
    return line[None], line[:, None]


def _opponents(linear: Pixels) -> Pixels:
    """YCxCz of linear sRGB: like CIELAB, but without the cube root."""
    x, y, z = np.moveaxis(linear @ _TO_XYZ.T / _WHITE, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def _from_opponents(opponents: Pixels) -> Pixels:
    y = (opponents[..., 0] + 16) / 116
    return np.stack([y + opponents[..., 1] / 500, y, y - opponents[..., 2] / 200], -1) * _WHITE @ _FROM_XYZ.T


def _hunt_lab(linear: Pixels) -> Pixels:
    """CIELAB of linear sRGB, adjusted so that dark colours are less colourful, as they appear (the Hunt effect)."""
    ratio = linear @ _TO_XYZ.T / _WHITE
    edge = 6 / 29
    root = np.where(ratio > edge**3, np.cbrt(ratio), ratio / (3 * edge**2) + 4 / 29)
    x, y, z = np.moveaxis(root, -1, 0)
    lightness = 116 * y - 16
    return np.stack([lightness, 5 * lightness * (x - y), 2 * lightness * (y - z)], -1)


def _hyab(first: Pixels, second: Pixels) -> Float32[np.ndarray, "*S"]:
    difference = first - second
    return np.abs(difference[..., 0]) + np.hypot(difference[..., 1], difference[..., 2])
