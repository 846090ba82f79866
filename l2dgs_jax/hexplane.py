"""The motion field: six planes of features over space and time (HexPlane, arXiv 2301.09632; Eq. 1).

A query fixes the time of all its points, so each space-time plane first collapses to a line, and only one-dimensional
lookups are left. Planes are stored channels last and read through flat row indices: one contiguous row a corner.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from l2dgs_jax.config import ModelConfig
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
        xy, yz, zx = _space_lookup(space, unit)
        zt, xt, yt = _time_lookup(time, unit, times)
        if cfg.aggregation == "paired_sum":
            scales.append(xy[None] * zt + yz[None] * xt + zx[None] * yt)
        else:
            scales.append((xy * yz * zx)[None] * (zt * xt * yt))
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
    bent = lambda stacks: [jnp.diff(stack, 2, axis=1) for stack in stacks if stack.shape[1] > 2]
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


def _rows(table: Float[Array, "R C"], index: Int[Array, "*S"]) -> Float[Array, "*S C"]:
    """Rows of a table; `_cell` keeps every index inside it, so neither bounds nor signs need checking."""
    return table.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _space_lookup(planes: Float[Array, "3 S S C"], unit: Float[Array, "N 3"]) -> list[Float[Array, "N C"]]:
    """Bilinear values of the planes XY, YZ, ZX."""
    size, channels = planes.shape[-2:]
    table = planes.reshape(-1, channels)
    low, weight = _cell(unit, size)
    values = []
    for plane, (a, b) in enumerate(SPACE_AXES):
        corner = (plane * size + low[:, a]) * size + low[:, b]
        u, v = weight[:, a, None], weight[:, b, None]
        before = (1 - v) * _rows(table, corner) + v * _rows(table, corner + 1)
        after = (1 - v) * _rows(table, corner + size) + v * _rows(table, corner + size + 1)
        values.append((1 - u) * before + u * after)
    return values


def _time_lookup(
    planes: Float[Array, "3 T S C"], unit: Float[Array, "N 3"], times: Float[Array, " V"]
) -> list[Float[Array, "V N C"]]:
    """Values of the planes Zt, Xt, Yt: mixed in time first, then read along the line that remains."""
    time_size, size, channels = planes.shape[1:]
    row, mix = _cell(times, time_size)
    mix = mix[None, :, None, None]
    lines = (1 - mix) * planes[:, row] + mix * planes[:, row + 1]
    table = lines.reshape(-1, channels)
    low, weight = _cell(unit, size)
    views = jnp.arange(times.shape[0], dtype=low.dtype)[:, None]
    values = []
    for plane, axis in enumerate(TIME_AXES):
        start = (plane * times.shape[0] + views) * size + low[None, :, axis]
        along = weight[None, :, axis, None]
        values.append((1 - along) * _rows(table, start) + along * _rows(table, start + 1))
    return values
