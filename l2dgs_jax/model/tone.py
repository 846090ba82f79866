"""What underexposure does to an sRGB image: where B1 and L_w start, and how bright the result is to be."""

from collections.abc import Iterator
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from l2dgs_jax.data.color import linear_to_srgb, srgb_to_linear

Tone = Literal["linear-light", "gain"]

LEAST_EXPONENT, MOST_EXPONENT = 1.01, 2.0  # B1 can come close to 1, not reach it
# Frames are clean if the smoothest of their windows deviate less than that from a plane, and flat if the log of their
# grey values does so from its mean.
CLEAN, FLAT = 1 / 255, 0.5
SMOOTHEST = 0.1  # share of the windows
WINDOW = 7  # pixels
LOOKED_AT = 12  # frames
MID_GREY = 0.46  # photographers' middle grey, 18 % linear, in sRGB
# Highlights, which all but some of the pixels stay below, shall stay below a value themselves. A lamp in view must not
# leave all else in the dark: the level gives way by no more than a stop.
HIGHLIGHTS, BRIGHTEST, MOST_GIVEN_WAY = 0.98, 0.9, 0.5


class Darkening(NamedTuple):
    """An underexposed value as gain * (well-exposed value)^exponent: sRGB values, or the light they stand for."""

    exponent: float
    gain: float
    of_light: bool = False

    def undone(self, values: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
        """The well-exposed sRGB values."""
        if not self.of_light:
            return (values / self.gain) ** (1 / self.exponent)
        return linear_to_srgb((srgb_to_linear(values) / self.gain) ** (1 / self.exponent))


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
        tone: how it became dark: "linear-light", as a camera does; by a "gain" on sRGB values, as many programs do; or
            the exponent itself.
        of_light: whether the law is to be one of light, where "linear-light" is a gain.
    """
    if of_light:
        dark, lit = srgb_to_linear(np.array([dark_level, lit_level]))
        return Darkening(LEAST_EXPONENT, min(dark / lit**LEAST_EXPONENT, 1.0), of_light=True)
    if tone == "linear-light":
        dark, lit = srgb_to_linear(np.array([dark_level, lit_level]))
        well = np.linspace(0.1, 0.9, 81)
        low = linear_to_srgb(min(dark / lit, 1.0) * srgb_to_linear(well))
        exponent = np.clip(np.polyfit(np.log(well), np.log(low), 1)[0], LEAST_EXPONENT, MOST_EXPONENT)
        return Darkening(float(exponent), float(np.exp(np.mean(np.log(low) - exponent * np.log(well)))))
    exponent = LEAST_EXPONENT if tone == "gain" else float(tone)
    return Darkening(exponent, min(dark_level / lit_level**exponent, 1.0))


def lit_level(
    images: Float[np.ndarray, "F H W 3"], valid: Bool[np.ndarray, "F H W"] | None, dark_level: float, *, of_light: bool
) -> float:
    """The mean sRGB value to bring dark frames to: mid-grey, or less where that would clip their highlights.

    Args:
        images: sRGB values in [0, 1].
        valid: which pixels count; None for all.
        dark_level: mean of `images`, in (0, 1).
        of_light: whether a factor on light is looked for, or one on sRGB values.
    """
    brightest = np.concatenate([image.max(-1)[counted] for image, counted in _looked_at(images, valid)])
    known = np.array([dark_level, MID_GREY, np.quantile(brightest, HIGHLIGHTS), BRIGHTEST])
    dark, grey, highlights, most = srgb_to_linear(known) if of_light else known
    level = np.asarray(grey * np.clip(most / (highlights * grey / dark), MOST_GIVEN_WAY, 1.0))
    return float(linear_to_srgb(level) if of_light else level)


def recognise(images: Float[np.ndarray, "F H W 3"], valid: Bool[np.ndarray, "F H W"] | None = None) -> Tone:
    """How dark frames became dark, as far as they tell.

    A sensor that sees little light is noisy, and what its scaled light loses in level the sRGB curve returns as
    contrast. Frames that are both clean and flat were darkened by a gain. A camera's own noise reduction and a scene
    of little contrast can look the same: only then is the answer wrong, and the user's to correct.

    Args:
        images: sRGB values in [0, 1].
        valid: which pixels count; None for all.
    """
    noise, levels = [], []
    for image, counted in _looked_at(images, valid):
        noise.append(_roughness(image)[counted])
        levels.append(image.mean(-1)[counted])
    clean = np.quantile(np.concatenate(noise), SMOOTHEST) < CLEAN
    flat = np.log(np.maximum(np.concatenate(levels), 0.5 / 255)).std() < FLAT
    return "gain" if clean and flat else "linear-light"


def _looked_at(
    images: Float[np.ndarray, "F H W 3"], valid: Bool[np.ndarray, "F H W"] | None
) -> Iterator[tuple[Float[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]]:
    for index in np.unique(np.linspace(0, len(images) - 1, LOOKED_AT).round().astype(int)):
        image = images[index].astype(np.float32)
        yield image, np.ones(image.shape[:2], bool) if valid is None else valid[index]


def _roughness(image: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
    """Deviation of what is left of the pixels around each one when planes are taken away (Immerkaer, 1996)."""
    rest = cv2.filter2D(image, -1, np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)) / 6
    return np.sqrt(cv2.blur(np.square(rest).mean(-1), (WINDOW, WINDOW)))
