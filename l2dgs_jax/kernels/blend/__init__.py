"""Front-to-back blending of the tiles' lists, and its gradient."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from l2dgs_jax.kernels.blend import accelerator, cpu, reference
from l2dgs_jax.kernels.blend.alpha import GEOMETRY_COLUMNS, PIXELS
from l2dgs_jax.kernels.selection import by_form, functions_by_form
from l2dgs_jax.kernels.tiles import TileLists

Residuals = tuple[Float[Array, "G D"], TileLists, Float[Array, "T C P"]]


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def blend(packed: Float[Array, "G D"], lists: TileLists, width: int, height: int) -> Float[Array, "T C P"]:
    """Blend the feature channels of every tile's list over its 8x8 pixels, nearest Gaussian first.

    alpha = min(0.999, o exp(-q/2)) with opacity o and q = d^T conic d, skipped below 1/255; the Gaussian that would
    bring the transmittance to 1e-4 or less ends its pixel and is itself left out (3DGS, arXiv 2308.04079). Gradients
    flow to `packed`, in reverse mode only; beyond the arguments, only the result is stored for them. A vmapped call
    blends the tiles of all members as one larger image.

    Args:
        packed: for each Gaussian, mean (2, pixels), conic (3), opacity, and C = D - 6 features.
        lists: the Gaussians that may touch each tile.
        width: pixels.
        height: pixels.
    """
    return _forward(packed, lists, width, height)[0]


def _forward(
    packed: Float[Array, "G D"], lists: TileLists, width: int, height: int
) -> tuple[Float[Array, "T C P"], Residuals]:
    shape = lists.starts.shape[0], packed.shape[1] - GEOMETRY_COLUMNS, PIXELS
    if not len(packed):
        output = jnp.zeros(shape, packed.dtype)
    else:
        output = _folded("blend", width, height, lambda packed, lists: _like(packed, len(lists.starts), *shape[1:]))(
            packed, lists
        )
    return output, (packed, lists, output)


def _backward(width: int, height: int, residuals: Residuals, cotangent: Float[Array, "T C P"]) -> tuple:
    packed, lists, output = residuals
    pull = _folded("gradient", width, height, lambda packed, *_: _like(packed, *packed.shape))
    gradient = pull(packed, lists, output, cotangent) if len(packed) else packed
    return gradient, jax.tree.map(lambda x: np.zeros(x.shape, jax.dtypes.float0), lists)


blend.defvjp(_forward, _backward)


def _like(packed: Float[Array, "G D"], *shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, packed.dtype)


def _folded(
    name: str, width: int, height: int, shape: Callable[..., jax.ShapeDtypeStruct]
) -> Callable[..., Float[Array, "..."]]:
    """The function of that name in the right form; under vmap it is called once, for the members' tiles in one row.

    The batching rule of a loop would run all members until the slowest ends, and select what to keep in every step.
    """
    size = {"width": width, "height": height}
    forms = functions_by_form(name, reference=reference, cpu=cpu, accelerator=accelerator, **size)
    folded = jax.custom_batching.custom_vmap(lambda *arguments: by_form(*arguments, **forms, like=shape(*arguments)))

    @folded.def_vmap
    def rule(members: int, batched: Any, *arguments: Any) -> tuple[Float[Array, "..."], bool]:
        def widen(x: Any, is_batched: bool) -> Any:
            return x if is_batched else jnp.broadcast_to(x[None], (members, *x.shape))

        packed, lists, *images = jax.tree.map(widen, arguments, tuple(batched))
        first = lambda size: size * jnp.arange(members, dtype=jnp.int32)[:, None]
        count, capacity = packed.shape[1], lists.gaussians.shape[1]
        lists = TileLists(lists.gaussians + first(count), lists.starts + first(capacity), lists.stops + first(capacity))
        flat = lambda x: x.reshape(-1, *x.shape[2:])
        result = folded(flat(packed), jax.tree.map(flat, lists), *map(flat, images))
        return result.reshape(members, -1, *result.shape[1:]), True

    return folded
