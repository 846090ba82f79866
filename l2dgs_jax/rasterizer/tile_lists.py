"""Which Gaussians touch which tile, nearest first: culling, listing and sorting."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.kernels.sort import argsort, sort_pairs
from l2dgs_jax.kernels.tile_lists import list_pairs
from l2dgs_jax.kernels.tiles import MIN_ALPHA, TILE_SIZE, TileLists, Tiling, grid
from l2dgs_jax.rasterizer.projection import Projected


class Footprints(NamedTuple):
    """Where in the images Gaussians are visible.

    Attributes:
        reach: largest d^T conic d at which alpha is at least 1/255; negative if it never is.
        radii: half-widths in x and y of the box around that ellipse, pixels; zero for Gaussians that are not drawn.
        first: first column and row of tiles that the box touches.
        counts: number of columns and rows of tiles; both zero for Gaussians that are not drawn.
    """

    reach: Float[Array, "V N"]
    radii: Float[Array, "V N 2"]
    first: Int[Array, "V N 2"]
    counts: Int[Array, "V N 2"]


def footprints(projected: Projected, opacities: Float[Array, "V N"], width: int, height: int) -> Footprints:
    """The opacity-aware box of tiles around each Gaussian; carries no gradients."""
    # The slack of 1e-3 keeps rounding errors from dropping a contribution of exactly 1/255.
    reach = 2 * jnp.log(jnp.maximum(opacities, 1e-30) / MIN_ALPHA) + 1e-3
    radii = jnp.sqrt(jnp.maximum(reach, 0)[..., None] * projected.covariances2d[..., ::2])
    shape = jnp.array(grid(width, height), radii.dtype)[None, None]
    # Measured between pixel centres, which lie 0.5 inside a tile's border.
    first = jnp.clip(jnp.ceil((projected.means2d - radii + 0.5) / TILE_SIZE) - 1, 0, shape)
    last = jnp.clip(jnp.floor((projected.means2d + radii - 0.5) / TILE_SIZE) + 1, 0, shape)
    broken = ~jnp.isfinite(projected.means2d + radii)
    first, last = jnp.where(broken, 0, first), jnp.where(broken, shape, last)
    counts = jnp.maximum(last - first, 0).astype(jnp.int32)
    drawn = projected.visible & ~(reach < 0) & jnp.all(counts > 0, axis=-1)
    return Footprints(
        reach, jnp.where(drawn[..., None], radii, 0), first.astype(jnp.int32), jnp.where(drawn[..., None], counts, 0)
    )


def pairs_needed(boxes: Footprints) -> Int[Array, ""]:
    """How many (Gaussian, tile) pairs the boxes hold, at most 2^31 - 1."""
    counts = jnp.prod(boxes.counts, axis=-1)
    most = jnp.iinfo(jnp.int32).max
    return jnp.where(jnp.sum(counts, dtype=jnp.float32) < most, jnp.sum(counts, dtype=jnp.int32), most)


def intersect(projected: Projected, boxes: Footprints, width: int, height: int, capacity: int) -> TileLists:
    """List the Gaussians of every tile of every view, sorted by depth; carries no gradients.

    Tiles are numbered view by view, row by row.

    Args:
        projected: V views of N Gaussians.
        boxes: their footprints.
        width: pixels.
        height: pixels.
        capacity: size of the list; pairs that do not fit are dropped (see `pairs_needed`).
    """
    views, count = boxes.reach.shape
    columns, rows = grid(width, height)
    tiles = columns * rows
    order = jax.vmap(argsort)(projected.depths)
    order = (order + count * jnp.arange(views, dtype=jnp.int32)[:, None]).reshape(-1)
    nearest_first = lambda x: x.reshape(views * count, *x.shape[2:])[order]

    box = nearest_first(jnp.concatenate([boxes.first, boxes.counts], axis=-1))
    ellipse = nearest_first(jnp.concatenate([projected.means2d, projected.conics, boxes.reach[..., None]], axis=-1))
    tile, slot = list_pairs(box, ellipse, Tiling(views, columns, rows, capacity))
    if not count:
        return TileLists(slot, jnp.zeros(views * tiles, jnp.int32), jnp.zeros(views * tiles, jnp.int32))
    tile, rank, starts = sort_pairs(tile, slot % count, views * tiles, count)
    slot = jnp.minimum(tile // tiles, views - 1) * count + rank
    return TileLists(order[jnp.minimum(slot, views * count - 1)], starts[:-1], starts[1:])
