"""A tile-based Gaussian rasterizer in plain JAX: cull, sort, scan."""

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.kernels.blend import blend
from l2dgs_jax.kernels.fusion import fusion_boundary
from l2dgs_jax.kernels.tiles import TILE_SIZE, grid
from l2dgs_jax.rasterizer.projection import EPS_2D, NEAR_PLANE, Projected, project
from l2dgs_jax.rasterizer.tile_lists import Footprints, footprints, intersect, pairs_needed
from l2dgs_jax.types import RasterOutput

LEAST_ALPHA = 1e-10  # least divisor of an expected depth; any pixel with a Gaussian has a larger alpha


def rasterize(
    means: Float[Array, "*B N 3"],
    quats: Float[Array, "*B N 4"],
    scales: Float[Array, "*B N 3"],
    opacities: Float[Array, "*B N"],
    features: Float[Array, "*B N C"],
    viewmat: Float[Array, "*V 4 4"],
    K: Float[Array, "*V 3 3"],
    width: int,
    height: int,
    *,
    near_plane: Float[Array, ""] | float = NEAR_PLANE,
    eps2d: float = EPS_2D,
    depth_mode: Literal["accumulated", "expected"] = "accumulated",
    means2d_probe: Float[Array, "*V N 2"] | None = None,
    pair_capacity: int | None = None,
) -> RasterOutput:
    """Draw Gaussians: all feature channels, alpha and depth in one pass (Eqs. 5, 6 and 8).

    Cameras have no leading axis, or an axis of views, which are sorted and blended together. Gaussians without a
    leading axis are shared by all views; with the axis of views, every view has its own. A contribution has
    alpha = min(0.999, o exp(-q/2)), with opacity o and Mahalanobis distance sqrt(q), and is skipped below 1/255. The
    Gaussian that would bring the transmittance to 1e-4 or less ends its pixel and is itself left out. No background.

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
        near_plane: world units, more than 0; Gaussians whose centre has a smaller depth are not drawn.
        eps2d: pixels^2, more than 0, added to the projected covariance so that no Gaussian falls between pixels. Every
            new value compiles the function again.
        depth_mode: kind of depth along the camera's z axis, world units: "accumulated", the sum of weight times z over
            the Gaussians of a pixel, or "expected", that sum divided by their accumulated opacity.
        means2d_probe: added to the projected centres, pixels: zeros whose gradient is dL/d(mean2d).
        pair_capacity: size of the buffer for (Gaussian, tile) pairs of all views. None counts the pairs first, which
            needs concrete arrays, so it works only outside jit and vmap.

    Raises:
        ValueError: `pair_capacity` is None under jit or vmap; Gaussians and cameras have different numbers of views; or
            there is no such `depth_mode`.
    """
    if depth_mode not in ("accumulated", "expected"):
        raise ValueError(f"depth_mode is {depth_mode!r}; expected 'accumulated' or 'expected'")
    views = viewmat.shape[:-2]
    gaussians: tuple[Array, ...] = (means, quats, scales, opacities, features)
    if means.ndim == 2 and views:
        gaussians = tuple(jnp.broadcast_to(x[None], (*views, *x.shape)) for x in gaussians)
    elif means.shape[:-2] != views:
        raise ValueError(f"Gaussians of {means.shape[:-2]} views for {views} cameras; expected as many, or shared ones")
    arrays = (*gaussians, viewmat, K, means2d_probe)
    if not views:
        arrays = jax.tree.map(lambda x: x[None], arrays)
    static = {"width": width, "height": height, "near_plane": near_plane, "eps2d": eps2d}
    if pair_capacity is None:
        try:
            *geometry, probe = jax.lax.stop_gradient((*arrays[:4], *arrays[5:]))
            needed = int(count_pairs(*geometry, means2d_probe=probe, **static))
        except jax.errors.ConcretizationTypeError:
            raise ValueError("rasterize needs a static pair_capacity under jit or vmap") from None
        # Rounded up to three significant bits: wastes at most a quarter of the buffer, and few sizes are compiled.
        step = 1 << max(needed.bit_length() - 3, 8)
        pair_capacity = max(-(-needed // step), 1) * step
    output = _rasterize(*arrays, **static, capacity=max(pair_capacity, 1))
    if depth_mode == "expected":
        output = output._replace(depth=output.depth / jnp.maximum(output.alpha, LEAST_ALPHA))
    return output if views else jax.tree.map(lambda x: x[0] if x.ndim else x, output)


def _prepare(
    means: Float[Array, "V N 3"],
    quats: Float[Array, "V N 4"],
    scales: Float[Array, "V N 3"],
    opacities: Float[Array, "V N"],
    viewmat: Float[Array, "V 4 4"],
    K: Float[Array, "V 3 3"],
    probe: Float[Array, "V N 2"] | None,
    width: int,
    height: int,
    near_plane: Float[Array, ""] | float,
    eps2d: float,
) -> tuple[Projected, Footprints]:
    view = partial(project, width=width, height=height, near_plane=near_plane, eps2d=eps2d)
    projected = jax.vmap(view)(means, quats, scales, viewmat, K)
    if probe is not None:
        projected = projected._replace(means2d=projected.means2d + probe)
    return projected, footprints(*jax.lax.stop_gradient((projected, opacities)), width, height)


@partial(jax.jit, static_argnames=("width", "height", "eps2d"))
def count_pairs(
    means: Float[Array, "V N 3"],
    quats: Float[Array, "V N 4"],
    scales: Float[Array, "V N 3"],
    opacities: Float[Array, "V N"],
    viewmat: Float[Array, "V 4 4"],
    K: Float[Array, "V 3 3"],
    width: int,
    height: int,
    *,
    near_plane: Float[Array, ""] | float = NEAR_PLANE,
    eps2d: float = EPS_2D,
    means2d_probe: Float[Array, "V N 2"] | None = None,
) -> Int[Array, ""]:
    """The `pair_capacity` that `rasterize` needs for the same arguments, at most 2^31 - 1."""
    cameras = viewmat, K, means2d_probe, width, height, near_plane, eps2d
    return pairs_needed(_prepare(means, quats, scales, opacities, *cameras)[1])


@partial(jax.jit, static_argnames=("width", "height", "eps2d", "capacity"))
def _rasterize(
    means: Float[Array, "V N 3"],
    quats: Float[Array, "V N 4"],
    scales: Float[Array, "V N 3"],
    opacities: Float[Array, "V N"],
    features: Float[Array, "V N C"],
    viewmat: Float[Array, "V 4 4"],
    K: Float[Array, "V 3 3"],
    probe: Float[Array, "V N 2"] | None,
    *,
    width: int,
    height: int,
    near_plane: Float[Array, ""] | float,
    eps2d: float,
    capacity: int,
) -> RasterOutput:
    cameras = viewmat, K, probe, width, height, near_plane, eps2d
    projected, boxes = _prepare(means, quats, scales, opacities, *cameras)
    pairs = pairs_needed(boxes)
    lists = intersect(jax.lax.stop_gradient(projected), boxes, width, height, capacity)

    channels = [features, projected.depths[..., None], jnp.ones_like(opacities)[..., None]]
    packed = jnp.concatenate([projected.means2d, projected.conics, opacities[..., None], *channels], axis=-1)
    blended = blend(packed.reshape(-1, packed.shape[-1]), lists, width, height)

    image = fusion_boundary(partial(_untiled, width=width, height=height))(blended)
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
    """The images that consist of these tiles."""
    columns, rows = grid(width, height)
    image = tiles.reshape(-1, rows, columns, tiles.shape[1], TILE_SIZE, TILE_SIZE).transpose(0, 1, 4, 2, 5, 3)
    return image.reshape(-1, rows * TILE_SIZE, columns * TILE_SIZE, tiles.shape[1])[:, :height, :width]
