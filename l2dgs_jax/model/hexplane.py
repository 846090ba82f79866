"""The motion field: six planes of features over space and time (HexPlane, arXiv 2301.09632; Eq. 1).

A query fixes the time of all its points, so each space-time plane first collapses to a line.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.kernels.hexplane_lookup import Layout, lerp, lookup
from l2dgs_jax.types import HexPlane


def time_cells(cfg: ModelConfig, num_frames: int) -> int:
    """Cells along the axis of time: `cfg.time_size`, or else half of the number of training frames, at least 2."""
    return max(num_frames // 2, 2) if cfg.time_size is None else cfg.time_size


def init(key: PRNGKeyArray, cfg: ModelConfig, num_frames: int) -> HexPlane:
    """Planes as 4DGS (arXiv 2310.08528) starts them: U(0.1, 0.5) in space, 1 in time.

    Features thus start independent of time: the product of three space features, or their sum under "paired_sum".

    Args:
        key: randomness of the space planes.
        cfg: sizes.
        num_frames: training frames.

    Raises:
        ValueError: an axis has fewer than two cells.
    """
    sizes = [scale * cfg.plane_size for scale in cfg.plane_scales]
    time_size = time_cells(cfg, num_frames)
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
    the feature of the nearest point of it, or with `cfg.box_rim` are contracted into a rim of cells around it.
    Gradients flow to `planes`, `points` (zero where they are clamped) and `times`, in reverse mode only.

    Args:
        planes: the six planes at each scale.
        points: canonical centres, world units.
        bounds: lowest and highest corner of the box; an axis of no extent is ignored.
        times: instants in [0, 1], clamped to it.
        cfg: `aggregation`, `time_range` and `box_rim`.

    Returns:
        The scales' features one after the other, F = scales * channels.
    """
    low, high = bounds[:1], bounds[1:]
    thick = high > low
    unit = jnp.where(thick, _contract((points - low) / jnp.where(thick, high - low, 1), cfg.box_rim), 0)
    # "upper" reproduces a sampler that expects [-1, 1]: times in [0, 1] then reach only half of the axis.
    times = jnp.clip(times if cfg.time_range == "full" else 0.5 + 0.5 * times, 0, 1)
    layout = Layout(tuple(space.shape[2] for space in planes.space), len(times), cfg.aggregation)
    everywhere = jnp.broadcast_to(unit.T[..., None], (3, len(points), len(layout.sizes)))
    cell, weight = _cell(everywhere, np.array(layout.sizes, np.int32)[None, None])
    found = lookup(
        _table(planes.space),
        _table(tuple(_at_times(time, times) for time in planes.time)),
        tuple(cell.reshape(3, -1)),
        tuple(weight.reshape(3, -1)),
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
    zero = jnp.zeros((), planes.space[0].dtype)
    return (
        zero + sum(3 * jnp.mean(jnp.square(bend)) for bend in _second_differences(planes.space)),
        zero + sum(3 * jnp.mean(jnp.square(bend)) for bend in _second_differences(planes.time)),
        zero + sum(3 * jnp.mean(jnp.abs(1 - stack)) for stack in planes.time),
    )


def _contract(unit: Float[Array, "*S"], rim: float) -> Float[Array, "*S"]:
    """Contract coordinates in which the box is [0, 1] so that all of space fits into [0, 1].

    The box takes the middle 1 - `rim`. Space beyond it fills the rest, compressed more and more with distance (as in
    Mip-NeRF 360, arXiv 2111.12077); without a rim it is clamped to the box.
    """
    if not rim:
        return jnp.clip(unit, 0, 1)
    centred = 2 * unit - 1
    distance = jnp.maximum(jnp.abs(centred), 1)
    beyond = jnp.sign(centred) * (1 - rim / (1 + (distance - 1) * (1 - rim) / rim))
    return 0.5 + 0.5 * jnp.where(jnp.abs(centred) <= 1, (1 - rim) * centred, beyond)


def _second_differences(stacks: tuple[Float[Array, "3 _ _ C"], ...]) -> list[Float[Array, "3 _ _ C"]]:
    """Along the first axis of the planes; those of two cells have none."""
    return [s[:, 2:] - 2 * s[:, 1:-1] + s[:, :-2] for s in stacks if s.shape[1] > 2]


def _cell(unit: Float[Array, "*S"], size: int | np.ndarray) -> tuple[Int[Array, "*S"], Float[Array, "*S"]]:
    """Index of the cell before each coordinate in [0, 1], and how far into it the coordinate lies."""
    position = unit * jnp.asarray(size - 1, unit.dtype)
    low = jnp.clip(jnp.floor(position).astype(jnp.int32), 0, size - 2)
    return low, position - low.astype(position.dtype)


def _table(stacks: tuple[Float[Array, "3 _ _ C"], ...]) -> Float[Array, "R C"]:
    """The rows of all scales, one after the other."""
    return jnp.concatenate([stack.reshape(-1, stack.shape[-1]) for stack in stacks])


def _at_times(planes: Float[Array, "3 T S C"], times: Float[Array, " V"]) -> Float[Array, "3 V S C"]:
    """The lines that the planes Zt, Xt, Yt collapse to at each time."""
    row, mix = _cell(times, planes.shape[1])
    shape = (3, len(times), *planes.shape[2:])
    return lerp(planes[:, row], planes[:, row + 1], jnp.broadcast_to(mix[None, :, None, None], shape))
