"""A loop over the rows of the result, whose values stay in the L1 cache."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from l2dgs_jax.kernels.compilation import native_call
from l2dgs_jax.kernels.hexplane_lookup.layout import (
    Cells,
    Layout,
    ScaleTables,
    Weights,
    interpolate,
    rows_read,
    tables_of_scale,
)
from l2dgs_jax.kernels.loops import Index, add_row, loop, read, read_row, write_row


def lookup(
    space: Float[Array, "R C"], lines: Float[Array, "L C"], cell: Cells, weight: Weights, *, layout: Layout
) -> Float[Array, "V M C"]:
    """See the contract in `__init__`; at least two rows."""
    count, channels = len(cell[0]), space.shape[1]

    def look_up(*inputs: Any) -> Float[Array, "VM C"]:
        def look(scale: ScaleTables, row: Index, found: Float[Array, "VM C"]) -> Float[Array, "VM C"]:
            _, (corners, ends, weights) = _inputs_of_row(layout.views, scale, inputs, row)
            for view, value in enumerate(interpolate(corners, ends, weights, layout.aggregation)):
                found = write_row(found, view * count + row, value)
            return found

        return _each_row(layout, count, look, jnp.zeros((layout.views * count, channels), space.dtype))

    return native_call(look_up)(space, lines, cell, weight).reshape(layout.views, count, channels)


def gradient(
    space: Float[Array, "R C"],
    lines: Float[Array, "L C"],
    cell: Cells,
    weight: Weights,
    cotangent: Float[Array, "V M C"],
    *,
    layout: Layout,
) -> tuple[Float[Array, "R C"], Float[Array, "L C"], Weights]:
    """The gradients of `lookup` with respect to `space`, `lines` and `weight`."""
    count, channels = len(cell[0]), space.shape[1]

    def pull_back(cotangent: Float[Array, "VM C"], *inputs: Any) -> tuple[Float[Array, "..."], ...]:
        def pull(scale: ScaleTables, row: Index, sums: Any) -> Any:
            rows, values = _inputs_of_row(layout.views, scale, inputs, row)
            _, transpose = jax.vjp(partial(interpolate, aggregation=layout.aggregation), *values)
            *in_tables, in_weights = transpose([read_row(cotangent, v * count + row) for v in range(layout.views)])
            *sums, per_channel = sums
            for k in range(2):
                for index, value in zip(jax.tree.leaves(rows[k]), jax.tree.leaves(in_tables[k]), strict=True):
                    sums[k] = add_row(sums[k], index, value)
            for axis, value in enumerate(in_weights):
                per_channel = write_row(per_channel, axis * count + row, value)
            return *sums, per_channel

        return _each_row(layout, count, pull, tuple(jnp.zeros(shape, space.dtype) for shape in shapes))

    shapes = space.shape, lines.shape, (3 * count, channels)
    in_space, in_lines, per_channel = native_call(pull_back)(
        cotangent.reshape(-1, channels), space, lines, cell, weight
    )
    # A matrix product instead of a sum, because sums over a few channels are slow on CPU.
    in_weights = jnp.matmul(per_channel, jnp.ones((channels, 1), space.dtype), precision="highest").reshape(3, count)
    return in_space, in_lines, tuple(in_weights)


def _inputs_of_row(views: int, scale: ScaleTables, inputs: Any, row: Index) -> tuple[Any, Any]:
    """The rows of the tables that a row of the result reads, and the arguments of `interpolate` for that row."""
    space, lines, cell, weight = inputs
    rows = rows_read(views, scale, tuple(read(x, row) for x in cell))  # type: ignore[arg-type]
    corners, ends = (
        jax.tree.map(partial(read_row, table), ids) for table, ids in zip((space, lines), rows, strict=True)
    )
    weights = [jnp.full((1, space.shape[1]), read(w, row)) for w in weight]
    return rows, (corners, ends, weights)


def _each_row(layout: Layout, count: int, body: Callable[[ScaleTables, Index, Any], Any], state: Any) -> Any:
    """A loop over the rows, scale by scale, because the planes of one scale may fit into a cache."""
    scales = len(layout.sizes)

    def each_point(scale: Index, state: Any) -> Any:
        tables = tables_of_scale(layout, scale)
        return loop(count // scales, lambda point, state: body(tables, point * scales + scale, state), state)

    return loop(scales, each_point, state)
