"""What underexposure does to sRGB images: the initial B1 and L_w, and how bright the result is to be."""

from collections.abc import Iterator
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from l2dgs_jax.data.color import MID_GREY, linear_to_srgb, srgb_to_linear
from l2dgs_jax.data.stacks import evenly_spread

Tone = Literal["linear-light", "gain"]

MIN_EXPONENT, MAX_EXPONENT = 1.01, 2.0  # B1 can come close to 1, not reach it
# Frames count as clean if a low quantile of their local noise is below a limit (texture looks like noise, so only the
# smoothest windows tell), and as flat if the standard deviation of their log grey values is below another.
NOISE_QUANTILE, MAX_CLEAN_NOISE, MAX_FLAT_CONTRAST = 0.1, 1 / 255, 0.5
NOISE_WINDOW = 7  # side in pixels of the window that local noise is measured in
SAMPLED_FRAMES = 12
# The level is lowered until the brightened highlights, a high quantile of the pixels, do not exceed a value; but only
# down to a part of itself, as a lamp in view must not leave all else in the dark.
HIGHLIGHT_QUANTILE, MAX_HIGHLIGHTS, MIN_LEVEL_FACTOR = 0.95, 0.9, 0.5


class Darkening(NamedTuple):
    """An underexposed value as gain * (well-exposed value)^exponent: sRGB values, or with `of_light` linear light."""

    exponent: float
    gain: float
    of_light: bool = False

    def undone(self, values: Float[np.ndarray, "*B 3"]) -> tuple[Float[np.ndarray, "*B 3"], Float[np.ndarray, "*B"]]:
        """The well-exposed sRGB values, and for what is brighter than white the light on it, relative to all else.

        Of colours brighter than that, such as those of lamps, the values are those under light that makes them white:
        gain * light * values^exponent darkens them again. The light is 1 for all others.
        """
        dark = srgb_to_linear(values) if self.of_light else values
        light = np.maximum(dark.max(-1) / self.gain, 1)
        color = (dark / (self.gain * light[..., None])) ** (1 / self.exponent)
        return linear_to_srgb(color) if self.of_light else color, light


def darkening(
    dark_level: float, lit_level: float, tone: Tone | float = "linear-light", *, of_light: bool = False
) -> Darkening:
    """The power law that describes an underexposed sRGB image of mean `dark_level`.

    Light scaled by k before the sRGB curve is close to a gain times a power of the well-exposed value after it, with
    an exponent above 1 that grows with darkness. k follows from the two levels; the law is fitted by least squares in
    log-log coordinates over the mid-tones, sRGB 0.1 to 0.9, with the exponent limited to [1.01, 2].

    Args:
        dark_level: mean sRGB value of the dark frames, in (0, 1).
        lit_level: mean sRGB value that a well-lit image is expected to have.
        tone: how it became dark: "linear-light", as in a camera; by a "gain" on sRGB values, as in many programs; or
            the exponent itself.
        of_light: whether the law is to be one of linear light, where "linear-light" is a gain; `tone` is then ignored.
    """
    if of_light:
        dark, lit = srgb_to_linear(np.array([dark_level, lit_level]))
        return Darkening(MIN_EXPONENT, min(dark / lit**MIN_EXPONENT, 1.0), of_light=True)
    if tone == "linear-light":
        dark, lit = srgb_to_linear(np.array([dark_level, lit_level]))
        well = np.linspace(0.1, 0.9, 81)
        low = linear_to_srgb(min(dark / lit, 1.0) * srgb_to_linear(well))
        slope = np.polyfit(np.log(well), np.log(low), 1)[0]
        exponent = round(float(np.clip(slope, MIN_EXPONENT, MAX_EXPONENT)), 3)
        return Darkening(exponent, float(np.exp(np.mean(np.log(low) - exponent * np.log(well)))))
    exponent = MIN_EXPONENT if tone == "gain" else float(tone)
    return Darkening(exponent, min(dark_level / lit_level**exponent, 1.0))


def lit_level(
    images: Float[np.ndarray, "F H W 3"], valid: Bool[np.ndarray, "F H W"] | None, dark_level: float, *, of_light: bool
) -> float:
    """The mean sRGB value to bring dark frames to: mid-grey, or less where that would clip their highlights.

    Args:
        images: sRGB values in [0, 1].
        valid: which pixels count; None for all.
        dark_level: mean of `images`, in (0, 1).
        of_light: whether frames are brightened by a factor on linear light, or by one on sRGB values.
    """
    brightest = np.concatenate([image.max(-1)[counted] for image, counted in _sampled_frames(images, valid)])
    known = np.array([dark_level, MID_GREY, np.quantile(brightest, HIGHLIGHT_QUANTILE), MAX_HIGHLIGHTS])
    dark, grey, highlights, limit = srgb_to_linear(known) if of_light else known
    brightened = max(highlights * grey / dark, 1e-6)  # highlights are 0 where hardly any pixel is not black
    level = np.asarray(grey * np.clip(limit / brightened, MIN_LEVEL_FACTOR, 1.0))
    return float(linear_to_srgb(level) if of_light else level)


def recognise(images: Float[np.ndarray, "F H W 3"], valid: Bool[np.ndarray, "F H W"] | None = None) -> Tone:
    """How dark frames became dark, as far as they show it.

    A sensor that sees little light is noisy, and the sRGB curve, which is steeper for dark values in log-log
    coordinates, raises the contrast. So frames that are both clean and flat were darkened by a gain. A camera's noise
    reduction together with a scene of little contrast can look the same: only then is the answer wrong, and the user
    has to correct it.

    Args:
        images: sRGB values in [0, 1].
        valid: which pixels count; None for all.
    """
    noise, levels = [], []
    for image, counted in _sampled_frames(images, valid):
        noise.append(_local_noise(image)[counted])
        levels.append(image.mean(-1)[counted])
    clean = np.quantile(np.concatenate(noise), NOISE_QUANTILE) < MAX_CLEAN_NOISE
    flat = np.log(np.maximum(np.concatenate(levels), 0.5 / 255)).std() < MAX_FLAT_CONTRAST
    return "gain" if clean and flat else "linear-light"


def sampled_frames(count: int, valid: Bool[np.ndarray, "F H W"] | None) -> Int[np.ndarray, " N"]:
    """Frames that stand for a clip of so many, evenly spread over those that have valid pixels."""
    shown = np.arange(count) if valid is None else np.flatnonzero([frame.any() for frame in valid])
    return shown[evenly_spread(len(shown), SAMPLED_FRAMES)]


def _sampled_frames(
    images: Float[np.ndarray, "F H W 3"], valid: Bool[np.ndarray, "F H W"] | None
) -> Iterator[tuple[Float[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]]:
    for index in sampled_frames(len(images), valid):
        image = images[index].astype(np.float32)
        yield image, np.ones(image.shape[:2], bool) if valid is None else valid[index]


def _local_noise(image: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
    """Standard deviation, in a window around each pixel, of what is not locally a plane (Immerkaer, 1996)."""
    rest = cv2.filter2D(image, -1, np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)) / 6
    return np.sqrt(cv2.blur(np.square(rest).mean(-1), (NOISE_WINDOW, NOISE_WINDOW)))
