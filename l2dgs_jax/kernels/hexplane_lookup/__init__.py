"""Interpolation in the six planes of a HexPlane (arXiv 2301.09632; Eq. 1), all scales and all instants at once.

A query fixes the time of all its points, so each space-time plane has been reduced to a line before, and only lookups
in spatial planes and in lines are left. Planes are stored channels last and read through flat row indices: each corner
of a cell is one contiguous row. All scales are looked up at once, as rows of one table.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from l2dgs_jax.kernels.hexplane_lookup import accelerator, cpu, reference
from l2dgs_jax.kernels.hexplane_lookup.layout import Cells, Layout, Weights, lerp
from l2dgs_jax.kernels.selection import by_form, functions_by_form

__all__ = ["Layout", "lerp", "lookup"]

Tables = tuple[Float[Array, "R C"], Float[Array, "L C"], Cells, Weights]


@partial(jax.custom_vjp, nondiff_argnums=(4,))
def lookup(
    space: Float[Array, "R C"], lines: Float[Array, "L C"], cell: Cells, weight: Weights, layout: Layout
) -> Float[Array, "V M C"]:
    """The argument of g in Eq. 1 for M = points x scales rows, the scales of a point one after the other.

    Gradients flow to `space`, `lines` and `weight`, in reverse mode only.

    Args:
        space: rows of the spatial planes: for each scale XY, YZ, ZX; the axis named first varies slower.
        lines: rows of the lines: for each scale Z, X, Y, each of these for every view.
        cell: x, y and z indices of the cell that each row of the result lies in.
        weight: relative position within the cell along x, y and z, in [0, 1].
        layout: what is fixed at compilation.
    """
    count, channels = len(cell[0]), space.shape[1]
    shape = layout.views, count, channels
    if not count:
        return jnp.zeros(shape, space.dtype)
    return by_form(
        space, lines, cell, weight, **_forms("lookup", layout, count), like=jax.ShapeDtypeStruct(shape, space.dtype)
    )


def _forms(name: str, layout: Layout, count: int) -> dict[str, Callable[..., Any]]:
    # A loop of one step would be unrolled, but native calls need loops.
    cpu_form = cpu if count > 1 else accelerator
    return functions_by_form(name, reference=reference, cpu=cpu_form, accelerator=accelerator, layout=layout)


def _forward(
    space: Float[Array, "R C"], lines: Float[Array, "L C"], cell: Cells, weight: Weights, layout: Layout
) -> tuple[Float[Array, "V M C"], Tables]:
    return lookup(space, lines, cell, weight, layout), (space, lines, cell, weight)


def _backward(layout: Layout, inputs: Tables, cotangent: Float[Array, "V M C"]) -> tuple:
    space, lines, cell, weight = inputs
    count = len(cell[0])
    if count:
        gradient = by_form(*inputs, cotangent, **_forms("gradient", layout, count), like=(space, lines, weight))
    else:
        gradient = jax.tree.map(jnp.zeros_like, (space, lines, weight))
    return *gradient[:2], jax.tree.map(lambda x: np.zeros(x.shape, jax.dtypes.float0), cell), gradient[2]


lookup.defvjp(_forward, _backward)
