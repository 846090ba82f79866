"""The picture that a browser shows of a rendered view."""

import numpy as np
from jaxtyping import Float, UInt8

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.data.images import to_bytes
from l2dgs_jax.model.rendering import expected_depth
from l2dgs_jax.runs.pictures import Output
from l2dgs_jax.types import RenderOutput
from l2dgs_jax.viewer.relighting import Light, relit
from l2dgs_jax.visualize import display

EDGE = 230  # grey of the curtain's edge
EMPTY = 0.5  # alpha below which nothing hides the trained cameras


def picture(
    output: RenderOutput, cfg: ModelConfig, kind: Output, light: Light, curtain: float, ranges: display.Ranges
) -> UInt8[np.ndarray, "H W 3"]:
    """One kind of output, the well-lit image in the light that is asked for; the low-light image left of the curtain.

    Args:
        output: a rendered view.
        cfg: shape of the scene.
        kind: what is shown.
        light: of the well-lit image.
        curtain: how much of the width it covers, from 0 to 1.
        ranges: of the kinds that have colours only by their range.
    """
    lit = kind == "welllit"
    image = to_bytes(np.asarray(relit(output.images, light, cfg))) if lit else display.shown(output, kind, ranges)
    edge = round(curtain * image.shape[1])
    if edge:
        image[:, :edge] = display.shown(output, "lowlight", ranges)[:, :edge]
        image[:, edge - 1 : edge] = EDGE
    return image


def hiding_depth(output: RenderOutput, unit: float) -> Float[np.ndarray, "H W"]:
    """Depth in `unit`s, infinite where the scene is too thin to hide what lies behind it."""
    return np.where(np.asarray(output.alpha) < EMPTY, np.inf, expected_depth(output) / unit)
