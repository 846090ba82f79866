"""Gaussians in the form that splat viewers draw."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from l2dgs_jax.kernels.tiles import MIN_ALPHA

Y_00 = 0.5 / np.sqrt(np.float32(np.pi))  # the spherical harmonic of degree 0


class Splats(NamedTuple):
    """Gaussians of one colour each, activated.

    Attributes:
        means: centres in world units.
        quats: rotations, wxyz, of norm 1.
        scales: standard deviations in world units.
        opacities: in [0, 1].
        colors: sRGB, blended as such; at least 0, and 1 is white.
    """

    means: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    scales: Float32[np.ndarray, "N 3"]
    opacities: Float32[np.ndarray, " N"]
    colors: Float32[np.ndarray, "N 3"]


def visible(splats: Splats) -> Splats:
    """The Gaussians that are visible in some image; others are too transparent."""
    drawn = splats.opacities >= MIN_ALPHA
    return Splats(*(rows[drawn] for rows in splats))


def sh_coefficients(colors: Float32[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
    """Coefficients c of colours 0.5 + c Y_00, which is how files store colours (3DGS, arXiv 2308.04079)."""
    return (colors - np.float32(0.5)) / Y_00
