"""Making the picture that a browser shows from a rendered view."""

import numpy as np
from jaxtyping import Float, UInt8

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.data.images import to_bytes
from l2dgs_jax.model.rendering import expected_depth
from l2dgs_jax.runs.pictures import Output
from l2dgs_jax.types import RenderOutput
from l2dgs_jax.viewer.relighting import Light, relit
from l2dgs_jax.visualize import display

EDGE_GREY = 230  # of the curtain's edge
HIDING_ALPHA = 0.5  # from which on the scene hides what is behind it, such as the frusta of training cameras


def picture(
    output: RenderOutput, cfg: ModelConfig, kind: Output, light: Light, curtain: float, ranges: display.Ranges
) -> UInt8[np.ndarray, "H W 3"]:
    """One kind of output, with the well-lit image relit; left of the curtain's edge, the low-light image.

    Args:
        output: a rendered view.
        cfg: settings of the model.
        kind: what is shown.
        light: of the well-lit image.
        curtain: share of the width that the curtain covers, from 0 to 1.
        ranges: of the colour-mapped kinds of output.
    """
    lit = kind == "welllit"
    image = to_bytes(np.asarray(relit(output.images, light, cfg))) if lit else display.shown(output, kind, ranges)
    edge = round(curtain * image.shape[1])
    if edge:
        image[:, :edge] = display.shown(output, "lowlight", ranges)[:, :edge]
        image[:, edge - 1 : edge] = EDGE_GREY
    return image


def hiding_depth(output: RenderOutput, unit: float) -> Float[np.ndarray, "H W"]:
    """Depth in `unit`s, for hiding objects behind the scene; infinite where it is too transparent to hide anything."""
    return np.where(np.asarray(output.alpha) < HIDING_ALPHA, np.inf, expected_depth(output) / unit)
