"""What underexposure does to an sRGB image: where B1 and L_w start."""

from typing import NamedTuple

import numpy as np

from l2dgs_jax.data.color import linear_to_srgb, srgb_to_linear


class Darkening(NamedTuple):
    """An underexposed sRGB value as gain * (well-exposed value)^exponent."""

    exponent: float
    gain: float


def darkening(dark_level: float, lit_level: float) -> Darkening:
    """The power law that best describes an underexposed sRGB image of mean `dark_level`.

    Light scaled by k before the sRGB curve is close to a gain times a power of the well-exposed value after it, with
    an exponent above 1 that grows with darkness. k follows from the two levels; the law is fitted by least squares in
    log-log coordinates over the mid-tones, sRGB 0.1 to 0.9, with the exponent limited to [1.01, 2].

    Args:
        dark_level: mean sRGB value of the dark frames, in (0, 1).
        lit_level: mean sRGB value that a well-lit image is expected to have.
    """
    dark, lit = srgb_to_linear(np.array([dark_level, lit_level]))
    well = np.linspace(0.1, 0.9, 81)
    low = linear_to_srgb(min(dark / lit, 1.0) * srgb_to_linear(well))
    exponent = np.clip(np.polyfit(np.log(well), np.log(low), 1)[0], 1.01, 2.0)
    return Darkening(float(exponent), float(np.exp(np.mean(np.log(low) - exponent * np.log(well)))))
