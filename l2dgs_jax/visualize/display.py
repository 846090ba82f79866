"""How what is rendered is shown: colours as they are, parts in grey, exponents and depth in viridis."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8

from l2dgs_jax.data.images import to_bytes
from l2dgs_jax.runs.pictures import Output, values
from l2dgs_jax.types import RenderOutput
from l2dgs_jax.visualize.sheet import viridis

COLOURED: tuple[Output, ...] = ("b1", "b2", "depth")
LEAST_RANGE = 0.01  # of a value; colours for less would show how an exponent that is one number is rounded

Ranges = dict[Output, tuple[float, float]]


def ranges(outputs: Sequence[RenderOutput]) -> Ranges:
    """From the 2nd to the 98th percentile of some views, for each kind that has colours only by its range."""
    spans = {kind: np.percentile([values(output, kind) for output in outputs], (2, 98)) for kind in COLOURED}
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
