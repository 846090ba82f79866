"""Moving Gaussians in few bytes: quantised values at key instants, between which a viewer interpolates linearly."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8, Shaped, UInt8, UInt16

from l2dgs_jax.exporters.splats import Splats
from l2dgs_jax.kernels.tiles import MIN_ALPHA

# A Gaussian counts as still if none of its values deviates more than this from the middle of its range over time:
STILL_PIXELS, STILL_QUAT, STILL_LOG_SCALE, STILL_OPACITY = 0.5, 0.02, 0.05, 0.01
LARGEST_SCALE_RATIO = np.exp(12.0)  # between the largest and the smallest scale; smaller scales are raised to it


class Geometry(NamedTuple):
    """Gaussians at K instants, except their colours.

    Attributes:
        positions: 0 to 65535 along each axis of the box.
        quats: rotations wxyz times 127.
        shapes: logarithms of the scales, 0 to 255 from the lowest to the highest, and opacities times 255.
    """

    positions: UInt16[np.ndarray, "K N 3"]
    quats: Int8[np.ndarray, "K N 4"]
    shapes: UInt8[np.ndarray, "K N 4"]


class Tracks(NamedTuple):
    """Gaussians at K >= 2 key instants, evenly spaced over [0, 1]: S that are still, then M that move.

    Attributes:
        still: the still ones, at one instant, which stands for all.
        moving: the moving ones, at K instants.
        colors: for each image, colours of all S + M at K instants; 255 means `brightest`.
        box: lowest and highest corner of the box around all centres, world units.
        log_scales: lowest and highest logarithm of a scale.
        brightest: upper limit of the colours.
    """

    still: Geometry
    moving: Geometry
    colors: tuple[UInt8[np.ndarray, "K N 3"], ...]
    box: Float[np.ndarray, "2 3"]
    log_scales: Float[np.ndarray, "2"]
    brightest: float


def quantise(instants: Sequence[tuple[Splats, ...]], pixels: Float[np.ndarray, " N"], brightest: float) -> Tracks:
    """Tracks of those Gaussians that are visible at some instant.

    Args:
        instants: at least two; for each, the same Gaussians in the colours of every image.
        pixels: for each Gaussian, the size of a pixel of the nearest camera at its depth, world units.
        brightest: upper limit of the colours.
    """
    over_time = lambda name: np.stack([np.asarray(getattr(splats[0], name), np.float64) for splats in instants])
    opacities = over_time("opacities")
    drawn = (opacities >= MIN_ALPHA).any(0)
    held = _held(opacities >= MIN_ALPHA)
    hold = lambda rows: np.take_along_axis(rows, held.reshape(*held.shape, *[1] * (rows.ndim - 2)), 0)[:, drawn]
    means, quats, scales = (hold(over_time(name)) for name in ("means", "quats", "scales"))
    opacities, quats = hold(opacities)[..., None], _continuous(quats)
    log_scales = np.log(np.maximum(scales, max(scales.max(initial=0) / LARGEST_SCALE_RATIO, np.finfo(float).tiny)))

    limits = ((means, STILL_PIXELS * pixels[drawn]), (quats, STILL_QUAT), (log_scales, STILL_LOG_SCALE))
    still = np.all([_stray(rows) <= limit for rows, limit in (*limits, (opacities, STILL_OPACITY))], axis=0)
    box = np.stack([means.min((0, 1)), means.max((0, 1))])
    ends = np.array([log_scales.min(), log_scales.max()])

    def geometry(chosen: Bool[np.ndarray, " N"], at_rest: bool) -> Geometry:
        rows = (x[:, chosen] for x in (means, quats, log_scales, opacities))
        m, q, s, o = ((x.min(0, keepdims=True) + x.max(0, keepdims=True)) / 2 if at_rest else x for x in rows)
        shapes = np.concatenate([_unit(s, *ends), o], axis=-1)
        return Geometry(
            np.rint(65535 * _unit(m, *box)).astype(np.uint16),
            np.rint(127 * q).astype(np.int8),
            np.rint(255 * shapes).astype(np.uint8),
        )

    order = np.argsort(~still, kind="stable")
    colors = (np.stack([splats[image].colors for splats in instants]) for image in range(len(instants[0])))
    integers = (np.rint(255 * _unit(hold(x)[:, order], 0.0, brightest)).astype(np.uint8) for x in colors)
    return Tracks(geometry(still, True), geometry(~still, False), tuple(integers), box, ends, brightest)


def at(tracks: Tracks, time: float) -> tuple[Splats, ...]:
    """What a viewer shows at an instant in [0, 1], in the colours of every image."""
    position = time * (len(tracks.moving.positions) - 1)
    key = min(int(position), len(tracks.moving.positions) - 2)
    part = np.float32(position - key)
    between = lambda rows: rows[key] + part * (rows[key + 1].astype(np.float32) - rows[key])
    both = zip(tracks.still, tracks.moving, strict=True)
    positions, quats, shapes = (
        np.concatenate([still[0], between(moving)]).astype(np.float32) for still, moving in both
    )
    (low, high), (least, most) = tracks.box, tracks.log_scales
    return tuple(
        Splats(
            (low + positions / 65535 * (high - low)).astype(np.float32),
            quats / np.linalg.norm(quats, axis=-1, keepdims=True),
            np.exp(least + shapes[:, :3] / 255 * (most - least)).astype(np.float32),
            shapes[:, 3] / np.float32(255),
            between(colors) * np.float32(tracks.brightest / 255),
        )
        for colors in tracks.colors
    )


def pack(tracks: Tracks) -> bytes:
    """All integers as bytes, in an order that deflate compresses well.

    The arrays of `still`, those of `moving`, then the colours. Each array is stored channel by channel, each channel
    with the low bytes before the high ones, and each of these for all Gaussians, key instant after key instant. From
    the second key instant on, these are differences from the previous one, modulo the range of the integers.
    """
    return b"".join(map(_planes, (*tracks.still, *tracks.moving, *tracks.colors)))


def _planes(rows: Shaped[np.ndarray, "K N C"]) -> bytes:
    steps = np.diff(np.moveaxis(rows, -1, 0), axis=1, prepend=rows.dtype.type(0))
    parts = np.ascontiguousarray(steps[..., None], steps.dtype.newbyteorder("<")).view(np.uint8)
    return np.moveaxis(parts, -1, 1).tobytes()


def _held(seen: Bool[np.ndarray, "K N"]) -> Int[np.ndarray, "K N"]:
    """Key instant to take a Gaussian's values from: the last one at which, or next to which, it is visible.

    Values of invisible Gaussians then do not change, which takes hardly any bytes.
    """
    padded = np.pad(seen, ((1, 1), (0, 0)))
    needed = padded[:-2] | padded[1:-1] | padded[2:]
    return np.maximum.accumulate(np.where(needed, np.arange(len(seen))[:, None], 0), axis=0)


def _continuous(quats: Float[np.ndarray, "K N 4"]) -> Float[np.ndarray, "K N 4"]:
    """The same rotations, each quaternion with the sign that is nearer to the previous one."""
    turns = np.where((quats[1:] * quats[:-1]).sum(-1) < 0, -1, 1).cumprod(0)
    return np.concatenate([quats[:1], turns[..., None] * quats[1:]])


def _stray(rows: Float[np.ndarray, "K N C"]) -> Float[np.ndarray, " N"]:
    return np.ptp(rows, axis=0).max(-1) / 2


def _unit(
    values: Float[np.ndarray, "*S"], low: Float[np.ndarray, "..."] | float, high: Float[np.ndarray, "..."] | float
) -> Float[np.ndarray, "*S"]:
    """Values scaled from [`low`, `high`] to [0, 1], and clipped."""
    size = np.maximum(np.asarray(high) - low, np.finfo(float).tiny)
    return np.clip((values - low) / size, 0, 1)
