"""The motion field: six planes of features over space and time (HexPlane, arXiv 2301.09632; Eq. 1)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.types import HexPlane

# Axes (X, Y, Z) of the space planes XY, YZ, ZX, and of the time planes Zt, Xt, Yt that they are paired with.
SPACE_AXES = ((0, 1), (1, 2), (2, 0))
TIME_AXES = (2, 0, 1)


def init(key: PRNGKeyArray, cfg: ModelConfig, num_frames: int) -> HexPlane:
    sizes = [scale * cfg.plane_size for scale in cfg.plane_scales]
    time_size = cfg.time_size or max(num_frames // 2, 2)
    keys = jax.random.split(key, len(sizes))
    return HexPlane(
        space=tuple(
            jax.random.uniform(k, (3, size, size, cfg.plane_channels), minval=0.1, maxval=0.5)
            for k, size in zip(keys, sizes, strict=True)
        ),
        time=tuple(jnp.ones((3, time_size, size, cfg.plane_channels)) for size in sizes),
    )


def _cell(coordinate, size):
    position = coordinate * (size - 1)
    low = jnp.clip(jnp.floor(position), 0, size - 2).astype(jnp.int32)
    return low, position - low.astype(position.dtype)


def _unit(points, bounds):
    return jnp.clip((points - bounds[:1]) / jnp.maximum(bounds[1:] - bounds[:1], 1e-12), 0, 1)


def space_features(planes, points, bounds):
    unit = _unit(points, bounds)
    scales = []
    for plane in planes.space:
        size, channels = plane.shape[1], plane.shape[3]
        low, weight = _cell(unit, size)
        table = plane.reshape(3 * size * size, channels)
        features = []
        for index, (a, b) in enumerate(SPACE_AXES):
            base = index * size * size + low[:, a] * size + low[:, b]
            u, v = weight[:, a, None], weight[:, b, None]
            features.append(
                (1 - u) * ((1 - v) * table[base] + v * table[base + 1])
                + u * ((1 - v) * table[base + size] + v * table[base + size + 1])
            )
        scales.append(tuple(features))
    return tuple(scales)


def features(planes, space, points, bounds, t, cfg):
    unit = _unit(points, bounds)
    outputs = []
    for plane, (xy, yz, zx) in zip(planes.time, space, strict=True):
        time_size, size = plane.shape[1:3]
        row, mix = _cell(t if cfg.time_range == "full" else 0.5 + 0.5 * t, time_size)
        lines = (1 - mix) * plane[:, row] + mix * plane[:, row + 1]
        low, weight = _cell(unit, size)
        zt, xt, yt = (
            (1 - weight[:, axis, None]) * line[low[:, axis]] + weight[:, axis, None] * line[low[:, axis] + 1]
            for axis, line in zip(TIME_AXES, lines, strict=True)
        )
        outputs.append(xy * zt + yz * xt + zx * yt if cfg.aggregation == "paired_sum" else xy * zt * yz * xt * zx * yt)
    return jnp.concatenate(outputs, axis=-1)


def regularisers(planes):
    second = lambda plane: jnp.mean(jnp.square(plane[:, 2:] - 2 * plane[:, 1:-1] + plane[:, :-2]), axis=(1, 2, 3)).sum()
    zero = jnp.zeros((), planes.space[0].dtype)
    return (
        sum((second(p) for p in planes.space), zero),
        sum((second(p) for p in planes.time if p.shape[1] > 2), zero),
        sum((jnp.abs(1 - p).mean(axis=(1, 2, 3)).sum() for p in planes.time), zero),
    )
