"""The motion field: six planes of features over space and time (HexPlane, arXiv 2301.09632; Eq. 1).

A query fixes the time of all its points, so each space-time plane first collapses to a line, and only one-dimensional
lookups are left. Planes are stored channels last and read through flat row indices: one contiguous row a corner. All
scales are looked up at once, as the rows of one table.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.native import add_row, by_platform, one_function, read, read_row, widen, write_row
from l2dgs_jax.types import HexPlane

# Axes (x, y, z = 0, 1, 2) of the space planes XY, YZ, ZX, and the axis of the time planes Zt, Xt, Yt paired with them.
SPACE_AXES = ((0, 1), (1, 2), (2, 0))
TIME_AXES = (2, 0, 1)

Rows = list[Float[Array, "M C"]]


class _Layout(NamedTuple):
    """What is static about a lookup: cells of a spatial axis at each scale, number of times, and `aggregation`."""

    sizes: tuple[int, ...]
    views: int
    aggregation: str


def init(key: PRNGKeyArray, cfg: ModelConfig, num_frames: int) -> HexPlane:
    """Planes as 4DGS (arXiv 2310.08528) starts them: U(0.1, 0.5) in space, 1 in time.

    Features thus start independent of time: the product of three space features, or their sum under "paired_sum".

    Args:
        key: randomness of the space planes.
        cfg: sizes. `cfg.time_size` None means half of `num_frames`, at least 2.
        num_frames: training frames.

    Raises:
        ValueError: an axis has fewer than two cells.
    """
    sizes = [scale * cfg.plane_size for scale in cfg.plane_scales]
    time_size = max(num_frames // 2, 2) if cfg.time_size is None else cfg.time_size
    if min(*sizes, time_size) < 2:
        raise ValueError(f"HexPlane needs at least 2 cells an axis, not {sizes} in space and {time_size} in time")
    keys = jax.random.split(key, len(sizes))
    return HexPlane(
        space=tuple(
            jax.random.uniform(k, (3, size, size, cfg.plane_channels), minval=0.1, maxval=0.5)
            for k, size in zip(keys, sizes, strict=True)
        ),
        time=tuple(jnp.ones((3, time_size, size, cfg.plane_channels)) for size in sizes),
    )


def features(
    planes: HexPlane,
    points: Float[Array, "N 3"],
    bounds: Float[Array, "2 3"],
    times: Float[Array, " V"],
    cfg: ModelConfig,
) -> Float[Array, "V N F"]:
    """Features of every point at every time, before the aggregation g (Eq. 1).

    Bilinear, with the first and last cell at the ends of the box and of the time axis. Points outside the box take
    the feature of the nearest point of it. Gradients flow to `planes`, `points` (zero outside the box) and `times`,
    in reverse mode only.

    Args:
        planes: the six planes at each scale.
        points: canonical centres, world units.
        bounds: lowest and highest corner of the box; an axis of no extent is ignored.
        times: instants in [0, 1], clamped to it.
        cfg: `aggregation` and `time_range`.

    Returns:
        The scales' features one after the other, F = scales * channels.
    """
    low, high = bounds[:1], bounds[1:]
    thick = high > low
    unit = jnp.where(thick, jnp.clip((points - low) / jnp.where(thick, high - low, 1), 0, 1), 0)
    # "upper" reproduces a sampler that expects [-1, 1]: times in [0, 1] then reach only half of the axis.
    times = jnp.clip(times if cfg.time_range == "full" else 0.5 + 0.5 * times, 0, 1)
    layout = _Layout(tuple(space.shape[2] for space in planes.space), len(times), cfg.aggregation)
    everywhere = jnp.broadcast_to(unit.T[..., None], (3, len(points), len(layout.sizes)))
    cell, weight = _cell(everywhere, np.array(layout.sizes, np.int32)[None, None])
    a_row_each = lambda x: tuple(x.reshape(3, -1))
    found = _lookup(
        _table(planes.space),
        _table(tuple(_at_times(time, times) for time in planes.time)),
        a_row_each(cell),
        a_row_each(weight),
        layout,
    )
    return found.reshape(len(times), len(points), -1)


def regularisers(planes: HexPlane) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """The three penalties of 4DGS (arXiv 2310.08528) on the planes. Gradients flow to `planes`.

    Each is a mean over the entries of a plane, summed over planes and scales.

    Returns:
        plane_smoothness: squared second differences of the space planes along their first axis only.
        time_smoothness: squared second differences of the time planes in time.
        time_l1: absolute differences of the time planes from 1, the value that leaves a pair independent of time.
    """
    total = lambda penalty, stacks: sum(3 * jnp.mean(penalty(stack)) for stack in stacks)
    # Planes of two cells have no second difference.
    bent = lambda stacks: [s[:, 2:] - 2 * s[:, 1:-1] + s[:, :-2] for s in stacks if s.shape[1] > 2]
    zero = jnp.zeros((), planes.space[0].dtype)
    return (
        zero + total(jnp.square, bent(planes.space)),
        zero + total(jnp.square, bent(planes.time)),
        zero + total(lambda stack: jnp.abs(1 - stack), planes.time),
    )


def _cell(unit: Float[Array, "*S"], size: int | np.ndarray) -> tuple[Int[Array, "*S"], Float[Array, "*S"]]:
    """Index of the cell before each coordinate in [0, 1], and how far into it the coordinate lies."""
    position = unit * jnp.asarray(size - 1, unit.dtype)
    low = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, size - 2)
    return low, position - low.astype(position.dtype)


def _lerp(start: Float[Array, "*S"], end: Float[Array, "*S"], weight: Float[Array, "*S"]) -> Float[Array, "*S"]:
    return start + weight * (end - start)


def _table(stacks: tuple[Float[Array, "3 _ _ C"], ...]) -> Float[Array, "R C"]:
    """The rows of all scales, one after the other."""
    return jnp.concatenate([stack.reshape(-1, stack.shape[-1]) for stack in stacks])


def _at_times(planes: Float[Array, "3 T S C"], times: Float[Array, " V"]) -> Float[Array, "3 V S C"]:
    """The lines that the planes Zt, Xt, Yt collapse to at each time."""
    row, mix = _cell(times, planes.shape[1])
    shape = (3, len(times), *planes.shape[2:])
    return _lerp(planes[:, row], planes[:, row + 1], jnp.broadcast_to(mix[None, :, None, None], shape))


@partial(jax.custom_vjp, nondiff_argnums=(4,))
def _lookup(
    space: Float[Array, "R C"],
    lines: Float[Array, "L C"],
    cell: tuple[Int[Array, " M"], ...],
    weight: tuple[Float[Array, " M"], ...],
    layout: _Layout,
) -> Float[Array, "V M C"]:
    """The argument of g in Eq. 1 for M = points x scales rows, the scales of a point one after the other.

    On CPU a loop over the rows, whose values never leave the first cache; elsewhere all rows at once.

    Args:
        space: see `_table`.
        lines: those of all times.
        cell: x, y and z of the cell that a row lies in.
        weight: how far into it.
        layout: what is static.
    """
    return _by_platform(_lookup_in_turn, _lookup_at_once, cell)(layout, space, lines, cell, weight)


def _lookup_forward(space, lines, cell, weight, layout):
    return _lookup(space, lines, cell, weight, layout), (space, lines, cell, weight)


def _lookup_backward(layout, inputs, cotangent):
    pull = _by_platform(_pull_in_turn, _pull_at_once, inputs[2])
    space, lines, weight = pull(layout, *inputs, cotangent)
    return space, lines, jax.tree.map(lambda x: np.zeros(x.shape, jax.dtypes.float0), inputs[2]), weight


_lookup.defvjp(_lookup_forward, _lookup_backward)


def _by_platform(in_turn, at_once, cell):
    # A loop of one step would be unrolled, and `one_function` wants loops.
    cpu = in_turn if len(cell[0]) > 1 else at_once
    return lambda layout, *arrays: by_platform(*arrays, cpu=partial(cpu, layout), default=partial(at_once, layout))


def _tables_of_scale(layout, scale):
    """Cells of a spatial axis at a scale, and its first rows in the tables of space and of lines."""
    sizes = np.array(layout.sizes, np.int32)
    at_scale = lambda x: jnp.asarray(x, jnp.int32).at[scale].get(mode="promise_in_bounds", wrap_negative_indices=False)
    first = lambda counts: at_scale(np.cumsum(counts) - counts)
    return at_scale(sizes), first(3 * sizes**2), first(3 * layout.views * sizes)


def _places(views, of_scale, cell):
    """Rows of the tables that a row of the lookup reads: four corners of each plane, two ends of each time's lines."""
    size, in_space, in_lines = of_scale
    corners = [
        [in_space + (plane * size + cell[a]) * size + cell[b] + offset for offset in (0, 1, size, size + 1)]
        for plane, (a, b) in enumerate(SPACE_AXES)
    ]
    ends = [
        [
            [in_lines + (line * views + view) * size + cell[axis] + offset for offset in (0, 1)]
            for line, axis in enumerate(TIME_AXES)
        ]
        for view in range(views)
    ]
    return corners, ends


def _interpolate(corners: list[Rows], ends: list[list[Rows]], weights: Rows, aggregation: str) -> Rows:
    """For each view, the argument of g in Eq. 1, or the product of all six features."""
    space = [
        _lerp(_lerp(c00, c01, weights[b]), _lerp(c10, c11, weights[b]), weights[a])
        for (a, b), (c00, c01, c10, c11) in zip(SPACE_AXES, corners, strict=True)
    ]
    values = []
    for lines in ends:
        time = [_lerp(start, end, weights[axis]) for axis, (start, end) in zip(TIME_AXES, lines, strict=True)]
        xy, yz, zx = (plane * line for plane, line in zip(space, time, strict=True))
        values.append(xy + yz + zx if aggregation == "paired_sum" else xy * yz * zx)
    return values


def _lookup_at_once(layout, space, lines, cell, weight):
    def gather(table, places):
        ids, structure = jax.tree.flatten(places)
        # `_cell` keeps every index inside the table, so neither bounds nor signs need checking.
        rows = table.at[jnp.concatenate(ids)].get(mode="promise_in_bounds", wrap_negative_indices=False)
        return jax.tree.unflatten(structure, jnp.split(rows, len(ids)))

    scale = jnp.arange(len(cell[0]), dtype=jnp.int32) % len(layout.sizes)
    corners, ends = _places(layout.views, _tables_of_scale(layout, scale), cell)
    weights = [widen(w, space.shape[1]) for w in weight]
    return jnp.stack(_interpolate(gather(space, corners), gather(lines, ends), weights, layout.aggregation))


def _pull_at_once(layout, space, lines, cell, weight, cotangent):
    look = lambda space, lines, weight: _lookup_at_once(layout, space, lines, cell, weight)
    return jax.vjp(look, space, lines, weight)[1](cotangent)


def _row_of_lookup(views, of_scale, inputs, row):
    """The places that a row reads, and the arrays of `_interpolate` for it alone."""
    space, lines, cell, weight = inputs
    places = _places(views, of_scale, [read(x, row) for x in cell])
    corners, ends = (
        jax.tree.map(partial(read_row, table), ids) for table, ids in zip((space, lines), places, strict=True)
    )
    weights = [jnp.full((1, space.shape[1]), read(w, row)) for w in weight]
    return places, (corners, ends, weights)


def _lookup_in_turn(layout, space, lines, cell, weight):
    count, channels = len(cell[0]), space.shape[1]

    def look_up(*inputs):
        def look(of_scale, row, found):
            _, (corners, ends, weights) = _row_of_lookup(layout.views, of_scale, inputs, row)
            for view, value in enumerate(_interpolate(corners, ends, weights, layout.aggregation)):
                found = write_row(found, view * count + row, value)
            return found

        return _each_row(layout, count, look, jnp.zeros((layout.views * count, channels), space.dtype))

    return _in_turn(look_up)(space, lines, cell, weight).reshape(layout.views, count, channels)


def _pull_in_turn(layout, space, lines, cell, weight, cotangent):
    count, channels = len(cell[0]), space.shape[1]

    def pull_back(cotangent, *inputs):
        def pull(of_scale, row, sums):
            places, values = _row_of_lookup(layout.views, of_scale, inputs, row)
            _, transpose = jax.vjp(partial(_interpolate, aggregation=layout.aggregation), *values)
            *in_tables, in_weights = transpose([read_row(cotangent, v * count + row) for v in range(layout.views)])
            *sums, per_channel = sums
            for k in range(2):
                for place, value in zip(jax.tree.leaves(places[k]), jax.tree.leaves(in_tables[k]), strict=True):
                    sums[k] = add_row(sums[k], place, value)
            for axis, value in enumerate(in_weights):
                per_channel = write_row(per_channel, axis * count + row, value)
            return *sums, per_channel

        return _each_row(layout, count, pull, tuple(jnp.zeros(shape, space.dtype) for shape in shapes))

    shapes = space.shape, lines.shape, (3 * count, channels)
    in_space, in_lines, per_channel = _in_turn(pull_back)(cotangent.reshape(-1, channels), space, lines, cell, weight)
    # A matrix product, because sums over a few channels are slow on CPU.
    in_weights = jnp.matmul(per_channel, jnp.ones((channels, 1), space.dtype), precision="highest").reshape(3, count)
    return in_space, in_lines, tuple(in_weights)


def _in_turn(function):
    return jax.custom_batching.sequential_vmap(one_function(function))


def _each_row(layout, count, body, state):
    """A loop over the rows, scale by scale: the planes of one scale may fit a cache."""
    loop = lambda length, body, state: jax.lax.fori_loop(jnp.int32(0), jnp.int32(length), body, state)
    scales = len(layout.sizes)

    def each_point(scale, state):
        of_scale = _tables_of_scale(layout, scale)
        return loop(count // scales, lambda point, state: body(of_scale, point * scales + scale, state), state)

    return loop(scales, each_point, state)
