"""A tile-based Gaussian rasterizer in plain JAX: cull, sort, scan."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.native import stage
from l2dgs_jax.projection import Projected, project
from l2dgs_jax.rasterizer.composite import composite
from l2dgs_jax.rasterizer.intersect import TILE, Footprints, footprints, grid, intersect, pairs_needed
from l2dgs_jax.types import RasterOutput


def rasterize(
    means: Float[Array, "*B N 3"],
    quats: Float[Array, "*B N 4"],
    scales: Float[Array, "*B N 3"],
    opacities: Float[Array, "*B N"],
    features: Float[Array, "*B N C"],
    viewmat: Float[Array, "*B 4 4"],
    K: Float[Array, "*B 3 3"],
    width: int,
    height: int,
    *,
    means2d_probe: Float[Array, "*B N 2"] | None = None,
    pair_capacity: int | None = None,
) -> RasterOutput:
    """Draw Gaussians: all feature channels, alpha and depth in one pass (Eqs. 5, 6 and 8).

    A leading axis holds views, each with its own Gaussians; their tiles go through one sort and one blend. A
    contribution has alpha = min(0.999, o exp(-q/2)) and is skipped below 1/255; the Gaussian that would bring the
    transmittance to 1e-4 or less ends its pixel and is left out. No background.

    Gradients flow to every array. alpha has none where it is clipped at 0.999.

    Args:
        means: centres, world units.
        quats: rotations, wxyz, any norm.
        scales: standard deviations along the principal axes, world units.
        opacities: in [0, 1].
        features: channels to blend.
        viewmat: world to camera, OpenCV axes.
        K: intrinsics, pixels.
        width: pixels.
        height: pixels.
        means2d_probe: added to the projected centres, pixels; zeros, whose gradient is dL/d(mean2d).
        pair_capacity: room for (Gaussian, tile) pairs of all views. None counts them first, which needs concrete
            arrays: outside jit and vmap only.

    Raises:
        ValueError: `pair_capacity` is None under a transformation that hides the arrays' values.
    """
    arrays = (means, quats, scales, opacities, features, viewmat, K, means2d_probe)
    batched = means.ndim == 3
    if not batched:
        arrays = jax.tree.map(lambda x: x[None], arrays)
    if pair_capacity is None:
        try:
            *geometry, probe = jax.lax.stop_gradient((*arrays[:4], *arrays[5:]))
            needed = int(count_pairs(*geometry, width, height, probe))
        except jax.errors.ConcretizationTypeError:
            raise ValueError("rasterize needs a static pair_capacity under jit or vmap") from None
        # Three significant bits: at most a quarter of the room is wasted, and few sizes are ever compiled.
        step = 1 << max(needed.bit_length() - 3, 8)
        pair_capacity = max(-(-needed // step), 1) * step
    output = _rasterize(*arrays, width, height, pair_capacity)
    if batched:
        return output
    return jax.tree.map(lambda x: x[0] if x.ndim else x, output)


def _prepare(means, quats, scales, opacities, viewmat, K, probe, width, height) -> tuple[Projected, Footprints]:
    projected = jax.vmap(partial(project, width=width, height=height))(means, quats, scales, viewmat, K)
    if probe is not None:
        projected = projected._replace(means2d=projected.means2d + probe)
    return projected, footprints(*jax.lax.stop_gradient((projected, opacities)), width, height)


@partial(jax.jit, static_argnames=("width", "height"))
def count_pairs(
    means: Float[Array, "V N 3"],
    quats: Float[Array, "V N 4"],
    scales: Float[Array, "V N 3"],
    opacities: Float[Array, "V N"],
    viewmat: Float[Array, "V 4 4"],
    K: Float[Array, "V 3 3"],
    width: int,
    height: int,
    means2d_probe: Float[Array, "V N 2"] | None = None,
) -> Int[Array, ""]:
    """The `pair_capacity` that `rasterize` needs for the same arguments, at most 2^31 - 1."""
    boxes = _prepare(means, quats, scales, opacities, viewmat, K, means2d_probe, width, height)[1]
    return pairs_needed(boxes)


@partial(jax.jit, static_argnums=(8, 9, 10))
def _rasterize(means, quats, scales, opacities, features, viewmat, K, probe, width, height, capacity):
    projected, boxes = _prepare(means, quats, scales, opacities, viewmat, K, probe, width, height)
    pairs = pairs_needed(boxes)
    lists = intersect(jax.lax.stop_gradient(projected), boxes, width, height, capacity)

    channels = [features, projected.depths[..., None], jnp.ones_like(opacities)[..., None]]
    packed = jnp.concatenate([projected.means2d, projected.conics, opacities[..., None], *channels], axis=-1)
    blended = composite(packed.reshape(-1, packed.shape[-1]), lists, width, height)

    image = stage(partial(_untiled, width=width, height=height))(blended)
    return RasterOutput(
        features=image[..., :-2],
        alpha=image[..., -1],
        depth=image[..., -2],
        means2d=projected.means2d,
        radii=jnp.max(boxes.radii, axis=-1),
        pairs=pairs,
        overflow=pairs > capacity,
    )


def _untiled(tiles: Float[Array, "T C P"], width: int, height: int) -> Float[Array, "V H W C"]:
    """The images that tiles belong to."""
    columns, rows = grid(width, height)
    image = tiles.reshape(-1, rows, columns, tiles.shape[1], TILE, TILE).transpose(0, 1, 4, 2, 5, 3)
    return image.reshape(-1, rows * TILE, columns * TILE, tiles.shape[1])[:, :height, :width]
