"""How rendered outputs are shown: images in colour, L and alpha in grey, exponents and depth with a colour map."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from l2dgs_jax.data.images import to_bytes
from l2dgs_jax.runs.pictures import Output, values
from l2dgs_jax.types import RenderOutput
from l2dgs_jax.visualize.sheet import viridis

COLOR_MAPPED: tuple[Output, ...] = ("b1", "b2", "depth")
LEAST_RANGE = 0.01  # relative; with a smaller range, a constant exponent would show rounding errors

Ranges = dict[Output, tuple[float, float]]


def ranges(outputs: Sequence[RenderOutput]) -> Ranges:
    """Ranges of the colour maps: from the 2nd to the 98th percentile over some views, for each colour-mapped kind."""
    spans = {kind: np.percentile([values(output, kind) for output in outputs], (2, 98)) for kind in COLOR_MAPPED}
    return {kind: (float(low), float(max(high, (1 + LEAST_RANGE) * low))) for kind, (low, high) in spans.items()}


def shown(output: RenderOutput, kind: Output, ranges: Ranges) -> UInt8[np.ndarray, "H W 3"]:
    """A picture of one kind of output."""
    image = values(output, kind)
    if kind in ranges:
        return viridis(image, *ranges[kind])
    return to_bytes(image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=-1))


def side_by_side(output: RenderOutput, kinds: Sequence[Output], ranges: Ranges) -> UInt8[np.ndarray, "H W 3"]:
    """Several kinds in one picture, from left to right."""
    return np.hstack([shown(output, kind, ranges) for kind in kinds])
