"""Which Gaussians touch which tile, nearest first: culling, listing and sorting."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.native import by_platform, one_function, read, write
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


def _touches(shape: tuple[Float[Array, "*S"], ...], x: Float[Array, "*S"], y: Float[Array, "*S"]) -> Bool[Array, "*S"]:
    """Whether an ellipse (mean, conic, reach) reaches the pixel centres of the tile whose lowest one is (x, y).

    A convex quadratic takes its minimum over a rectangle that excludes its centre on one of the (at most two) sides
    that face the centre.
    """
    mean_x, mean_y, a, b, c, reach = shape
    low_x, low_y = x - mean_x, y - mean_y
    high_x, high_y = low_x + (TILE - 1), low_y + (TILE - 1)
    q = lambda x, y: a * x * x + 2 * b * x * y + c * y * y
    near_x, near_y = jnp.clip(0, low_x, high_x), jnp.clip(0, low_y, high_y)
    along_y = q(near_x, jnp.clip(-b * near_x / c, low_y, high_y))
    along_x = q(jnp.clip(-b * near_y / a, low_x, high_x), near_y)
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
    listing = {"views": views, "columns": columns, "rows": rows, "capacity": capacity}
    forms = [partial(form, **listing) for form in (_list_in_turn, _list_at_once)]
    # XLA aborts on an argument of `one_function` that its simplifications leave unused, as they might for one row.
    cpu, default = forms if views * count > 1 else (forms[1], forms[1])
    tile, slot = by_platform(box, shape, cpu=cpu, default=default)
    tile, rank, starts = group(tile, slot % count, views * tiles, count)
    slot = jnp.minimum(tile // tiles, views - 1) * count + rank
    return TileLists(order[jnp.minimum(slot, views * count - 1)], starts[:-1], starts[1:])


def _list_at_once(box, shape, *, views, columns, rows, capacity):
    """For each pair its tile and the row of its Gaussian; pairs that do not touch have the tile after the last."""
    count = box.shape[0]
    sizes = box[:, 2] * box[:, 3]
    ends = jnp.cumsum(sizes, dtype=jnp.int32)
    slot = jnp.repeat(jnp.arange(count, dtype=jnp.int32), sizes, total_repeat_length=capacity)
    pair = jnp.arange(capacity, dtype=jnp.int32)
    box, shape = box[slot], shape[slot]
    within = pair - (ends - sizes)[slot]
    column_count = jnp.maximum(box[:, 2], 1)
    column, row = box[:, 0] + within % column_count, box[:, 1] + within // column_count
    x, y = (TILE * place.astype(shape.dtype) + 0.5 for place in (column, row))
    kept = (pair < ends[-1]) & _touches(tuple(shape.T), x, y)
    first = slot // (count // views) * (columns * rows)
    return jnp.where(kept, first + row * columns + column, views * columns * rows), slot


def _list_in_turn(box, shape, *, views, columns, rows, capacity):
    """The same pairs by a loop over the Gaussians; those that touch take the first places."""
    count = box.shape[0] // views
    nowhere = views * columns * rows

    def listed(box, shape):
        def list_gaussian(slot, state):
            left, top, width, height = (read(column, slot) for column in box)
            ellipse = tuple(read(column, slot) for column in shape)
            first = slot // count * (columns * rows)

            def list_tile(row, column, state):
                end, tiles, slots = state
                x, y = (TILE * place.astype(ellipse[0].dtype) + 0.5 for place in (column, row))
                # What does not touch is overwritten by the next pair that does; the place after the last is spare.
                tiles = write(tiles, end, first + row * columns + column)
                slots = write(slots, end, slot)
                return jnp.minimum(end + _touches(ellipse, x, y).astype(jnp.int32), capacity), tiles, slots

            in_row = lambda row, state: loop(left, left + width, partial(list_tile, row), state)
            return loop(top, top + height, in_row, state)

        loop = jax.lax.fori_loop
        tiles = jnp.full(capacity + 1, nowhere, jnp.int32)
        end, tiles, slots = loop(
            jnp.int32(0), jnp.int32(box[0].shape[0]), list_gaussian, (jnp.int32(0), tiles, jnp.zeros_like(tiles))
        )
        return write(tiles, end, jnp.int32(nowhere))[:capacity], slots[:capacity]

    columns_of = lambda x: tuple(x.T)
    return jax.custom_batching.sequential_vmap(one_function(listed))(columns_of(box), columns_of(shape))
