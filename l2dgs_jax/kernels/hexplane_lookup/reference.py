"""Plane by plane and line by line; differentiated by JAX."""

from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.kernels.hexplane_lookup.layout import SPACE_AXES, TIME_AXES, Cells, Layout, Weights, gradient_of


def lookup(
    space: Float[Array, "R C"], lines: Float[Array, "L C"], cell: Cells, weight: Weights, *, layout: Layout
) -> Float[Array, "V M C"]:
    """See the contract in `__init__`."""
    scales, channels = len(layout.sizes), space.shape[1]
    found = []
    for scale, size in enumerate(layout.sizes):
        before = layout.sizes[:scale]
        planes = space[3 * sum(s * s for s in before) :][: 3 * size * size].reshape(3, size, size, channels)
        of_views = lines[3 * layout.views * sum(before) :][: 3 * layout.views * size]
        of_views = of_views.reshape(3, layout.views, size, channels)
        own = slice(scale, None, scales)
        found.append(_features(layout, planes, of_views, [c[own] for c in cell], [w[own, None] for w in weight]))
    return jnp.stack(found, axis=2).reshape(layout.views, -1, channels)


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


def _features(
    layout: Layout,
    planes: Float[Array, "3 S S C"],
    lines: Float[Array, "3 V S C"],
    cell: list[Int[Array, " P"]],
    weight: list[Float[Array, "P 1"]],
) -> Float[Array, "V P C"]:
    """The result of `lookup` for one scale."""
    terms = []
    for plane, (a, b), line, axis in zip(planes, SPACE_AXES, lines, TIME_AXES, strict=True):
        i, j, k = cell[a], cell[b], cell[axis]
        u, v, w = weight[a], weight[b], weight[axis]
        low = (1 - v) * plane[i, j] + v * plane[i, j + 1]
        high = (1 - v) * plane[i + 1, j] + v * plane[i + 1, j + 1]
        in_space = (1 - u) * low + u * high
        in_time = (1 - w)[None] * line[:, k] + w[None] * line[:, k + 1]
        terms.append(in_space[None] * in_time)
    return sum(terms) if layout.aggregation == "paired_sum" else terms[0] * terms[1] * terms[2]
