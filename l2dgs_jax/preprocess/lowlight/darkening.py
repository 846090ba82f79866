"""Low-light pictures from well-lit ones, as LEDNet's pipeline makes them (arXiv 2202.03373).

A darkener turns the lightness of a picture into that of its dark twin, given the exposure that is wanted of every
pixel; the ratio of the two lightnesses then scales all three channels, and eight bits are left by truncation.
"""

from collections.abc import Callable
from typing import Literal

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from l2dgs_jax.data.color import linear_to_srgb, srgb_to_linear
from l2dgs_jax.preprocess.lowlight import curve_network

SATURATED = 0.97  # lightness from which a pixel shows a light source or clipped white
HIGHLIGHT_POWER = 33  # of the analytic curve

LabOrder = Literal["correct", "lednet"]
Image = Float32[np.ndarray, "H W 3"]
Plane = Float32[np.ndarray, "H W"]
Darkener = Callable[[Plane, Plane], Plane]  # (lightness, exposure) -> dark lightness, all in [0, 1]


def darken(image: Image, exposure: float, darkener: Darkener, order: LabOrder, brighten: bool = False) -> Image:
    """The dark twin of a picture, sRGB in [0, 1], before noise and truncation.

    Args:
        image: sRGB values in [0, 1].
        exposure: mean lightness wanted of the dark twin, saturated pixels aside.
        darkener: analytic or network.
        order: see `lightness`.
        brighten: let pixels become brighter where the darkener says so, as LEDNet does; else no ratio exceeds 1.
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
        order: "lednet" takes red for blue and blue for red, as LEDNet's script does.
    """
    code = cv2.COLOR_RGB2LAB if order == "correct" else cv2.COLOR_BGR2LAB
    return np.clip(cv2.cvtColor(image, code)[..., 0] / 100, 0, 1)


def saturated(lightness: Float32[np.ndarray, "*B"]) -> Bool[np.ndarray, "*B"]:
    """LEDNet's saturation map: pixels that stay bright however short the exposure."""
    return lightness > SATURATED


def exposure_map(lightness: Float32[np.ndarray, "*B"], exposure: float) -> Float32[np.ndarray, "*B"]:
    """The lightness wanted of every pixel: `exposure`, and their own of saturated ones."""
    return np.where(saturated(lightness), lightness, np.float32(exposure))


def network_darkener(net: curve_network.CurveNet) -> Darkener:
    """Curves from a network that sees the neighbourhood of every pixel; compiled once for every size of picture."""
    compiled = jax.jit(lambda light, exposure: curve_network.iterate(light, curve_network.curves(net, light, exposure)))
    return lambda light, exposure: np.asarray(compiled(jnp.asarray(light), jnp.asarray(exposure)))


def analytic_darkener(sample: Float32[np.ndarray, " N"], exposure: float) -> Darkener:
    """One tone curve for all pixels, y = s x + (1 - s) x^33: a scale s, from which only highlights depart towards 1.

    It keeps the order of lightnesses, and nearly their ratios: a video that is darkened by one such curve does not
    flicker as its content changes.

    Args:
        sample: lightness of pixels of everything that the curve is for; s brings the mean of those that are not
            saturated to the exposure, and is 1 if they are darker than that.
        exposure: as for `darken`.
    """
    rest = sample[~saturated(sample)]
    scale = np.float32(min(exposure / max(float(rest.mean(dtype=np.float64)), 1e-6), 1)) if rest.size else np.float32(1)
    return lambda light, _: scale * light + (1 - scale) * light**HIGHLIGHT_POWER


def scale_light(image: Image, factor: float) -> Image:
    """The picture with `factor` times the light, sRGB in [0, 1]: 1 leaves it exactly as it is."""
    if factor == 1:
        return image
    return linear_to_srgb(np.clip(factor * srgb_to_linear(image), 0, 1)).astype(np.float32)


def add_sensor_noise(image: Image, seed: tuple[int, ...], photons: float, read_noise: float) -> Image:
    """Photon (Poisson) and read-out (Gaussian) noise of a sensor that sees linear light.

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
    """Eight bits by truncation; values that rounding errors keep from a whole level count as that level."""
    return np.floor(255 * np.clip(image, 0, 1) + 1e-3).astype(np.uint8)
