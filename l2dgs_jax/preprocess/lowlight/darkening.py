"""Low-light pictures from well-lit ones, as a camera or LEDNet's pipeline makes them (arXiv 2202.03373).

A camera scales linear light. In LEDNet's pipeline, a darkener turns the lightness of a picture into that of its dark
twin, given the target exposure of every pixel. The ratio of the two lightnesses then scales all three channels, and the
result is truncated to 8 bits.
"""

from collections.abc import Callable
from typing import Literal

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy.optimize import brentq

from l2dgs_jax.data.color import linear_to_srgb, srgb_to_linear
from l2dgs_jax.preprocess.lowlight import curve_network

SATURATED = 0.97  # lightness above which a pixel is taken for a light source or clipped white
HIGHLIGHT_POWER = 33  # exponent in the analytic curve

LabOrder = Literal["correct", "lednet"]
Image = Float32[np.ndarray, "H W 3"]
Plane = Float32[np.ndarray, "H W"]
Darkener = Callable[[Plane, Plane], Plane]  # (lightness, exposure) -> dark lightness, all in [0, 1]


def darken(image: Image, exposure: float, darkener: Darkener, order: LabOrder, brighten: bool = False) -> Image:
    """The dark twin of a picture, sRGB in [0, 1], before noise and truncation.

    Args:
        image: sRGB values in [0, 1].
        exposure: target mean lightness of the dark twin, not counting saturated pixels.
        darkener: see `analytic_darkener` and `network_darkener`.
        order: see `lightness`.
        brighten: whether pixels may become brighter if the darkener says so, as in LEDNet.
    """
    light = lightness(image, order)
    ratio = darkener(light, exposure_map(light, exposure)) / (light + 1e-10)
    if not brighten:
        ratio = np.minimum(ratio, 1)
    return np.clip(image * ratio[..., None], 0, 1)


def lightness(image: Image, order: LabOrder = "correct") -> Plane:
    """CIE L* of sRGB values, scaled to [0, 1].

    Args:
        image: sRGB values in [0, 1].
        order: "lednet" swaps red and blue, as LEDNet's script does.
    """
    if not image.size:
        return np.zeros(image.shape[:2], np.float32)  # OpenCV refuses empty images
    code = cv2.COLOR_RGB2LAB if order == "correct" else cv2.COLOR_BGR2LAB
    return np.clip(cv2.cvtColor(image, code)[..., 0] / 100, 0, 1)


def saturated(lightness: Float32[np.ndarray, "*B"]) -> Bool[np.ndarray, "*B"]:
    """LEDNet's saturation map: pixels that stay bright however short the exposure."""
    return lightness > SATURATED


def exposure_map(lightness: Float32[np.ndarray, "*B"], exposure: float) -> Float32[np.ndarray, "*B"]:
    """The target lightness of every pixel: `exposure`, but its own lightness where it is saturated."""
    return np.where(saturated(lightness), lightness, np.float32(exposure))


def network_darkener(net: curve_network.CurveNet) -> Darkener:
    """A darkener by curves from a network that sees the neighbourhood of every pixel; compiled for each image size."""
    compiled = jax.jit(lambda light, exposure: curve_network.iterate(light, curve_network.curves(net, light, exposure)))
    return lambda light, exposure: np.asarray(compiled(jnp.asarray(light), jnp.asarray(exposure)))


def analytic_darkener(sample: Float32[np.ndarray, " N"], exposure: float) -> Darkener:
    """A darkener by one tone curve for all pixels, y = s x + (1 - s) x^33: a scale s, except that highlights tend to 1.

    It preserves the order of lightnesses and nearly their ratios; a video darkened by one such curve does not flicker
    as its content changes.

    Args:
        sample: lightness of pixels from all pictures that the curve is for; s brings the mean of the unsaturated ones
            to the exposure, and is 1 if they are already darker.
        exposure: as for `darken`.
    """
    rest = sample[~saturated(sample)]
    scale = np.float32(min(exposure / max(float(rest.mean(dtype=np.float64)), 1e-6), 1)) if rest.size else np.float32(1)
    return lambda light, _: scale * light + (1 - scale) * light**HIGHLIGHT_POWER


def light_factor(pixels: Float32[np.ndarray, "P 1 3"], exposure: float, order: LabOrder = "correct") -> float:
    """The factor on light by which pixels, sRGB in [0, 1], come to the mean lightness `exposure`; 1 if they are darker.

    Saturated pixels do not count.
    """
    pixels = pixels[~saturated(lightness(pixels, order))[:, 0]]
    excess = lambda factor: float(lightness(scale_light(pixels, factor), order).mean(dtype=np.float64)) - exposure
    if not len(pixels) or excess(1.0) <= 0:
        return 1.0
    return float(brentq(excess, 0.0, 1.0, xtol=1e-6))


def scale_light(image: Image, factor: float) -> Image:
    """The picture with `factor` times the light, sRGB in [0, 1]; a factor of 1 leaves it exactly unchanged."""
    if factor == 1:
        return image
    return linear_to_srgb(np.clip(factor * srgb_to_linear(image), 0, 1)).astype(np.float32)


def add_sensor_noise(image: Image, seed: tuple[int, ...], photons: float, read_noise: float) -> Image:
    """Add photon noise (Poisson) and read noise (Gaussian) of a sensor, in linear light.

    Args:
        image: sRGB values in [0, 1].
        seed: of this picture's noise.
        photons: electrons that white stands for; fewer is noisier.
        read_noise: standard deviation in electrons.
    """
    rng = np.random.default_rng(seed)
    electrons = rng.poisson(photons * srgb_to_linear(image)) + rng.normal(0, read_noise, image.shape)
    return linear_to_srgb(np.clip(electrons / photons, 0, 1)).astype(np.float32)


def truncate(image: Image) -> UInt8[np.ndarray, "H W 3"]:
    """Truncate to 8 bits; values that are below a whole level only by rounding errors count as that level."""
    return np.floor(255 * np.clip(image, 0, 1) + 1e-3).astype(np.uint8)
