"""All rows at once: one gather from each table."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from l2dgs_jax.kernels.fusion import repeat_channels
from l2dgs_jax.kernels.hexplane_lookup.layout import (
    Cells,
    Layout,
    Weights,
    gradient_of,
    interpolate,
    rows_read,
    tables_of_scale,
)


def lookup(
    space: Float[Array, "R C"], lines: Float[Array, "L C"], cell: Cells, weight: Weights, *, layout: Layout
) -> Float[Array, "V M C"]:
    """See the contract in `__init__`."""

    def gather(table: Float[Array, "N C"], rows: list) -> list:
        ids, structure = jax.tree.flatten(rows)
        # Every cell lies inside its plane, so neither bounds nor signs need checking.
        values = table.at[jnp.concatenate(ids)].get(mode="promise_in_bounds", wrap_negative_indices=False)
        return jax.tree.unflatten(structure, jnp.split(values, len(ids)))

    scale = jnp.arange(len(cell[0]), dtype=jnp.int32) % len(layout.sizes)
    corners, ends = rows_read(layout.views, tables_of_scale(layout, scale), cell)
    weights = [repeat_channels(w, space.shape[1]) for w in weight]
    return jnp.stack(interpolate(gather(space, corners), gather(lines, ends), weights, layout.aggregation))


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
    return gradient_of(partial(lookup, layout=layout), space, lines, cell, weight, cotangent)
