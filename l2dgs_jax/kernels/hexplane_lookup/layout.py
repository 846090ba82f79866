"""Where the rows of the lookup tables lie, and how values are interpolated from them."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

# Axes (x, y, z = 0, 1, 2) of the space planes XY, YZ, ZX, and the axis of the time planes Zt, Xt, Yt paired with them.
SPACE_AXES = ((0, 1), (1, 2), (2, 0))
TIME_AXES = (2, 0, 1)

Cells = tuple[Int[Array, "*M"], Int[Array, "*M"], Int[Array, "*M"]]
Weights = tuple[Float[Array, "*M"], Float[Array, "*M"], Float[Array, "*M"]]
Rows = list[Float[Array, "M C"]]
ScaleTables = tuple[Int[Array, "*M"], Int[Array, "*M"], Int[Array, "*M"]]
Corners = list[list[Int[Array, "*M"]]]  # rows of the corners of cells, for each plane
Ends = list[list[list[Int[Array, "*M"]]]]  # rows of the ends of cells, for each view and line


class Layout(NamedTuple):
    """What is fixed at compilation.

    Attributes:
        sizes: number of cells along a spatial axis, at each scale.
        views: number of instants.
        aggregation: "paired_sum" (Eq. 1) or "product" of all six features.
    """

    sizes: tuple[int, ...]
    views: int
    aggregation: str


def lerp(start: Float[Array, "*S"], end: Float[Array, "*S"], weight: Float[Array, "*S"]) -> Float[Array, "*S"]:
    """Linear interpolation."""
    return start + weight * (end - start)


def tables_of_scale(layout: Layout, scale: Int[Array, "*M"]) -> ScaleTables:
    """For a scale: cells along a spatial axis, its first row in the table of planes, and in that of lines."""

    def at_scale(values: Int[np.ndarray, " S"]) -> Int[Array, "..."]:
        return jnp.asarray(values, jnp.int32).at[scale].get(mode="promise_in_bounds", wrap_negative_indices=False)

    def first_row(counts: Int[np.ndarray, " S"]) -> Int[Array, "..."]:
        return at_scale(np.cumsum(counts) - counts)

    sizes = np.array(layout.sizes, np.int32)
    return at_scale(sizes), first_row(3 * sizes**2), first_row(3 * layout.views * sizes)


def rows_read(views: int, tables: ScaleTables, cell: Cells) -> tuple[Corners, Ends]:
    """Rows of the tables that one lookup reads: four corners in each plane, and two ends in each line of each view."""
    size, in_space, in_lines = tables
    corners = [
        [in_space + (plane * size + cell[a]) * size + cell[b] + offset for offset in (0, 1, size, size + 1)]
        for plane, (a, b) in enumerate(SPACE_AXES)
    ]
    ends = [
        [
            [in_lines + (line * views + view) * size + cell[axis] + offset for offset in (0, 1)]
            for line, axis in enumerate(TIME_AXES)
        ]
        for view in range(views)
    ]
    return corners, ends


def interpolate(corners: list[Rows], ends: list[list[Rows]], weights: Rows, aggregation: str) -> Rows:
    """For each view, the argument of g in Eq. 1, or the product of all six features; gradients flow to all arrays.

    Args:
        corners: for each spatial plane, the values [M C] at the four corners of the cells.
        ends: for each view and line, the values [M C] at the two ends of the cells.
        weights: relative position within the cell, along x, y and z.
        aggregation: see `Layout`.
    """
    space = [
        lerp(lerp(c00, c01, weights[b]), lerp(c10, c11, weights[b]), weights[a])
        for (a, b), (c00, c01, c10, c11) in zip(SPACE_AXES, corners, strict=True)
    ]
    values = []
    for lines in ends:
        time = [lerp(start, end, weights[axis]) for axis, (start, end) in zip(TIME_AXES, lines, strict=True)]
        xy, yz, zx = (plane * line for plane, line in zip(space, time, strict=True))
        values.append(xy + yz + zx if aggregation == "paired_sum" else xy * yz * zx)
    return values


def gradient_of(
    lookup: Callable[..., Float[Array, "V M C"]],
    space: Float[Array, "R C"],
    lines: Float[Array, "L C"],
    cell: Cells,
    weight: Weights,
    cotangent: Float[Array, "V M C"],
) -> tuple[Float[Array, "R C"], Float[Array, "L C"], Weights]:
    """The gradients of a lookup with respect to `space`, `lines` and `weight`, as JAX derives them."""
    _, pull = jax.vjp(lambda space, lines, weight: lookup(space, lines, cell, weight), space, lines, weight)
    return pull(cotangent)
