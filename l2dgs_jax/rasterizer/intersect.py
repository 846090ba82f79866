"""Which Gaussians touch which tile, nearest first: culling, listing and sorting."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.projection import Projected
from l2dgs_jax.rasterizer.sorting import argsort, group

TILE = 8  # pixels
MIN_ALPHA = 1 / 255  # fainter contributions are skipped


class TileLists(NamedTuple):
    """For each tile of all views, the Gaussians that may touch it, nearest first.

    Attributes:
        gaussians: flat indices (view * N + n), the lists one after the other.
        starts: where each tile's list starts.
        stops: where it ends.
    """

    gaussians: Int[Array, " M"]
    starts: Int[Array, " T"]
    stops: Int[Array, " T"]


class Footprints(NamedTuple):
    """Where Gaussians can be seen.

    Attributes:
        reach: largest d^T conic d at which alpha reaches 1/255; negative where it never does.
        radii: half-widths of the box around that ellipse, pixels; zero where nothing is drawn.
        first: first column and row of tiles that the box touches.
        counts: number of columns and rows; both zero where nothing is drawn.
    """

    reach: Float[Array, "V N"]
    radii: Float[Array, "V N 2"]
    first: Int[Array, "V N 2"]
    counts: Int[Array, "V N 2"]


def grid(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of tiles that cover an image."""
    return -(-width // TILE), -(-height // TILE)


def footprints(projected: Projected, opacities: Float[Array, "V N"], width: int, height: int) -> Footprints:
    """The opacity-aware box of tiles around each Gaussian; carries no gradients."""
    # The slack keeps a rounding error from dropping a contribution of exactly 1/255.
    reach = 2 * jnp.log(jnp.maximum(opacities, 1e-30) / MIN_ALPHA) + 1e-3
    radii = jnp.sqrt(jnp.maximum(reach, 0)[..., None] * projected.covariances2d[..., ::2])
    shape = jnp.array(grid(width, height), radii.dtype)[None, None]
    # Measured between pixel centres, which lie 0.5 inside a tile's border.
    first = jnp.clip(jnp.ceil((projected.means2d - radii + 0.5) / TILE) - 1, 0, shape)
    last = jnp.clip(jnp.floor((projected.means2d + radii - 0.5) / TILE) + 1, 0, shape)
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


def _touches(
    means2d: Float[Array, "M 2"], conics: Float[Array, "M 3"], reach: Float[Array, " M"], corner: Float[Array, "M 2"]
) -> Bool[Array, " M"]:
    """Whether an ellipse reaches a tile's rectangle of pixel centres, whose lowest corner is `corner`.

    A convex quadratic takes its minimum over a rectangle that excludes its centre on one of the (at most two) sides
    that face the centre.
    """
    low, high = corner - means2d, corner + (TILE - 1) - means2d
    a, b, c = conics[:, 0], conics[:, 1], conics[:, 2]
    q = lambda x, y: a * x * x + 2 * b * x * y + c * y * y
    x, y = jnp.clip(0, low, high).T
    along_y = q(x, jnp.clip(-b * x / c, low[:, 1], high[:, 1]))
    along_x = q(jnp.clip(-b * y / a, low[:, 0], high[:, 0]), y)
    return ~(jnp.minimum(along_x, along_y) > reach)


def intersect(projected: Projected, boxes: Footprints, width: int, height: int, capacity: int) -> TileLists:
    """List the Gaussians of every tile of every view, sorted by depth; carries no gradients.

    Tiles are numbered view by view, row by row.

    Args:
        projected: V views of N Gaussians.
        boxes: their footprints.
        width: pixels.
        height: pixels.
        capacity: size of the list; pairs beyond it are dropped (see `pairs_needed`).
    """
    views, count = boxes.reach.shape
    columns, rows = grid(width, height)
    tiles = columns * rows
    order = jax.vmap(argsort)(projected.depths)
    order = (order + count * jnp.arange(views, dtype=jnp.int32)[:, None]).reshape(-1)
    nearest_first = lambda x: x.reshape(views * count, *x.shape[2:])[order]

    box = nearest_first(jnp.concatenate([boxes.first, boxes.counts], axis=-1))
    shape = nearest_first(jnp.concatenate([projected.means2d, projected.conics, boxes.reach[..., None]], axis=-1))
    sizes = box[:, 2] * box[:, 3]
    ends = jnp.cumsum(sizes, dtype=jnp.int32)
    slot = jnp.repeat(jnp.arange(views * count, dtype=jnp.int32), sizes, total_repeat_length=capacity)
    pair = jnp.arange(capacity, dtype=jnp.int32)
    box, shape = box[slot], shape[slot]
    within = pair - (ends - sizes)[slot]
    column_count = jnp.maximum(box[:, 2], 1)
    column, row = box[:, 0] + within % column_count, box[:, 1] + within // column_count
    corner = TILE * jnp.stack([column, row], axis=-1).astype(shape.dtype) + 0.5
    kept = (pair < ends[-1]) & _touches(shape[:, :2], shape[:, 2:5], shape[:, 5], corner)
    tile = jnp.where(kept, slot // count * tiles + row * columns + column, views * tiles)

    tile, rank, starts = group(tile, slot % count, views * tiles, count)
    slot = jnp.minimum(tile // tiles, views - 1) * count + rank
    return TileLists(order[jnp.minimum(slot, views * count - 1)], starts[:-1], starts[1:])
