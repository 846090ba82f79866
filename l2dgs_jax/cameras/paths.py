"""Paths that cameras fly along."""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from l2dgs_jax.cameras.geometry import camera_centres
from l2dgs_jax.types import Camera


def space_time_path(cameras: Camera, frames: int) -> Camera:
    """A smooth path along the trained views: a quarter of it at the first instant, then time runs from 0 to 1.

    The pose at an instant is the Gaussian-weighted mean of the views around it, plus a gentle sway within the image
    plane. Where the views jump about from frame to frame, their mean would be no place to stand: the most central
    view stands for all of them.

    Args:
        cameras: F trained views in any order.
        frames: how many cameras to return.

    Returns:
        The path, as `frames` cameras of NumPy arrays of the type of `cameras`.
    """
    times = np.asarray(cameras.time, np.float64)
    rotations = np.asarray(cameras.viewmat[:, :3, :3], np.float64)
    centres = camera_centres(np.asarray(cameras.viewmat, np.float64))
    intrinsics = np.asarray(cameras.K, np.float64)
    size = _rms(centres - centres.mean(0))
    bandwidth = max(0.04, 1.5 / len(times))  # of the whole duration, and never less than a few views

    if _rms(centres - _nearby(times, times, bandwidth) @ centres) > 0.5 * size:
        central = np.argmin(np.linalg.norm(centres - np.median(centres, axis=0), axis=-1))
        rotations, centres, intrinsics = (
            np.broadcast_to(x[central], x.shape) for x in (rotations, centres, intrinsics)
        )

    still = frames // 4
    instants = np.concatenate([np.zeros(still), np.linspace(0, 1, frames - still)])
    weights = _nearby(instants, times, bandwidth)
    turned = np.stack([Rotation.from_matrix(rotations).mean(w).as_matrix() for w in weights])
    phase = np.linspace(0, 4 * np.pi, frames)
    sway = 0.2 * size * np.stack([np.sin(phase), 0.3 * np.sin(2 * phase)], axis=-1)
    moved = weights @ centres + np.einsum("fk,fki->fi", sway, turned[:, :2])

    viewmat = np.tile(np.eye(4), (frames, 1, 1))
    viewmat[:, :3, :3] = turned
    viewmat[:, :3, 3] = -np.einsum("fij,fj->fi", turned, moved)
    K = np.einsum("fv,vij->fij", weights, intrinsics)
    path: list[Any] = [x.astype(cameras.viewmat.dtype) for x in (viewmat, K, instants)]
    return Camera(*path)


def _nearby(at: Float[np.ndarray, " A"], times: Float[np.ndarray, " F"], bandwidth: float) -> Float[np.ndarray, "A F"]:
    """Gaussian weights of the views around each instant; rows sum to 1."""
    exponent = -0.5 * ((at[:, None] - times[None]) / bandwidth) ** 2
    weights = np.exp(exponent - exponent.max(-1, keepdims=True))
    return weights / weights.sum(-1, keepdims=True)


def _rms(offsets: Float[np.ndarray, "F 3"]) -> float:
    return float(np.sqrt((offsets**2).sum(-1).mean()))
