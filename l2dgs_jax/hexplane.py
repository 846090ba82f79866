"""The motion field: six planes of features over space and time (HexPlane, arXiv 2301.09632; Eq. 1).

A query fixes the time of all its points, so each space-time plane first collapses to a line, and only one-dimensional
lookups are left. Planes are stored channels last and read through flat row indices: one contiguous row a corner.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.native import widen
from l2dgs_jax.types import HexPlane

# Axes (x, y, z = 0, 1, 2) of the space planes XY, YZ, ZX, and the axis of the time planes Zt, Xt, Yt paired with them.
SPACE_AXES = ((0, 1), (1, 2), (2, 0))
TIME_AXES = (2, 0, 1)


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
    the feature of the nearest point of it. Gradients flow to `planes`, `points` (zero outside the box) and `times`.

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
    scales = []
    for space, time in zip(planes.space, planes.time, strict=True):
        low, weight = _cell(unit, space.shape[2])
        weights = [widen(weight[:, axis], space.shape[3]) for axis in range(3)]
        in_space = _space_lookup(space, low, weights)
        # Views in a Python loop: broadcasting one over the other transposes to a sum over views, which is slow.
        at_times = [_aggregate(in_space, lines, cfg) for lines in _time_lookup(time, low, weights, times)]
        scales.append(jnp.stack(at_times))
    return jnp.concatenate(scales, axis=-1)


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


def _cell(unit: Float[Array, "*S"], size: int) -> tuple[Int[Array, "*S"], Float[Array, "*S"]]:
    """Index of the cell before each coordinate in [0, 1], and how far into it the coordinate lies."""
    position = unit * (size - 1)
    low = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, size - 2)
    return low, position - low.astype(position.dtype)


def _lerp(start: Float[Array, "*S"], end: Float[Array, "*S"], weight: Float[Array, "*S"]) -> Float[Array, "*S"]:
    return start + weight * (end - start)


def _rows(table: Float[Array, "R C"], indices: list[Int[Array, " N"]]) -> list[Float[Array, "N C"]]:
    """For each index vector, those rows of the table: one gather in all, hence one scatter backward.

    `_cell` keeps every index inside the table, so neither bounds nor signs need checking.
    """
    rows = table.at[jnp.concatenate(indices)].get(mode="promise_in_bounds", wrap_negative_indices=False)
    return jnp.split(rows, len(indices))


def _space_lookup(
    planes: Float[Array, "3 S S C"], low: Int[Array, "N 3"], weights: list[Float[Array, "N C"]]
) -> list[Float[Array, "N C"]]:
    """Bilinear values of the planes XY, YZ, ZX."""
    size, channels = planes.shape[2:]
    table = planes.reshape(-1, channels)
    corner = lambda offset: _rows(
        table, [(plane * size + low[:, a]) * size + low[:, b] + offset for plane, (a, b) in enumerate(SPACE_AXES)]
    )
    corners = zip(SPACE_AXES, corner(0), corner(1), corner(size), corner(size + 1), strict=True)
    return [
        _lerp(_lerp(c00, c01, weights[b]), _lerp(c10, c11, weights[b]), weights[a])
        for (a, b), c00, c01, c10, c11 in corners
    ]


def _time_lookup(
    planes: Float[Array, "3 T S C"],
    low: Int[Array, "N 3"],
    weights: list[Float[Array, "N C"]],
    times: Float[Array, " V"],
) -> list[list[Float[Array, "N C"]]]:
    """For each time, the values of the planes Zt, Xt, Yt: mixed in time, then read along the line that remains."""
    row, mix = _cell(times, planes.shape[1])
    views, (size, channels) = range(len(times)), planes.shape[2:]
    lines = _lerp(
        planes[:, row], planes[:, row + 1], jnp.broadcast_to(mix[None, :, None, None], (3, len(times), size, channels))
    )
    table = lines.reshape(-1, channels)
    end = lambda offset: _rows(
        table,
        [
            (line * len(times) + view) * size + low[:, axis] + offset
            for view in views
            for line, axis in enumerate(TIME_AXES)
        ],
    )
    values = [
        _lerp(before, after, weights[TIME_AXES[k % 3]])
        for k, (before, after) in enumerate(zip(end(0), end(1), strict=True))
    ]
    return [values[3 * view : 3 * view + 3] for view in views]


def _aggregate(
    space: list[Float[Array, "N C"]], time: list[Float[Array, "N C"]], cfg: ModelConfig
) -> Float[Array, "N C"]:
    """The argument of g in Eq. 1, or the product of all six features."""
    xy, yz, zx = (plane * line for plane, line in zip(space, time, strict=True))
    return xy + yz + zx if cfg.aggregation == "paired_sum" else xy * yz * zx
