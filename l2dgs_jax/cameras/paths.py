"""Paths that cameras fly along, as batches of cameras in NumPy arrays of the type of the trained views'."""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from l2dgs_jax.cameras.geometry import camera_centres, mean_up
from l2dgs_jax.types import Camera

ALL_AROUND = np.radians(120)  # cameras stand around a scene if no gap between them is wider, seen from its middle


def space_time_path(cameras: Camera, frames: int) -> Camera:
    """A smooth path along the trained views: a quarter of it at the first instant, then time runs from 0 to 1.

    It is that of `interpolate` plus a gentle sway within the image plane.

    Args:
        cameras: F trained views in any order.
        frames: how many cameras to return.
    """
    still = frames // 4
    path = interpolate(cameras, np.concatenate([np.zeros(still), np.linspace(0, 1, frames - still)]))
    centres = camera_centres(np.asarray(cameras.viewmat, np.float64))
    phase = np.linspace(0, 4 * np.pi, frames)
    sway = 0.2 * _rms(centres - centres.mean(0)) * np.stack([np.sin(phase), 0.3 * np.sin(2 * phase)], axis=-1)
    path.viewmat[:, :2, 3] -= sway
    return path


def interpolate(cameras: Camera, times: Float[np.ndarray, " T"]) -> Camera:
    """The way of the trained views, without the shake of the hand.

    The pose at an instant is the Gaussian-weighted mean of the views around it. Where the views jump about from frame
    to frame, their mean would be no place to stand: the most central view stands for all of them.

    Args:
        cameras: F trained views in any order.
        times: instants of the cameras to return, in [0, 1].
    """
    trained = np.asarray(cameras.time, np.float64)
    rotations = np.asarray(cameras.viewmat[:, :3, :3], np.float64)
    centres = camera_centres(np.asarray(cameras.viewmat, np.float64))
    intrinsics = np.asarray(cameras.K, np.float64)
    bandwidth = _bandwidth(trained)
    if not is_path(cameras):
        central = _most_central(centres)
        rotations, centres, intrinsics = (
            np.broadcast_to(x[central], x.shape) for x in (rotations, centres, intrinsics)
        )
    weights = _nearby(times, trained, bandwidth)
    turned = np.stack([Rotation.from_matrix(rotations).mean(w).as_matrix() for w in weights])
    return _cameras(turned, weights @ centres, np.einsum("tf,fij->tij", weights, intrinsics), times, cameras)


def is_path(cameras: Camera) -> bool:
    """Whether views follow one another, and do not jump about from frame to frame."""
    trained = np.asarray(cameras.time, np.float64)
    centres = camera_centres(np.asarray(cameras.viewmat, np.float64))
    aside = centres - _nearby(trained, trained, _bandwidth(trained)) @ centres
    return _rms(aside) <= 0.5 * _rms(centres - centres.mean(0))


def spiral(cameras: Camera, depth: float, times: Float[np.ndarray, " T"]) -> Camera:
    """Two turns around the most central view, looking at the centre of attention (as LLFF, arXiv 1905.00889).

    They are as wide as the trained views spread, within bounds: some parallax shows, and the scene stays in view.

    Args:
        cameras: F trained views in any order.
        depth: how far away the scene is, world units (`median_depth`).
        times: instants of the cameras to return, in [0, 1].
    """
    viewmats = np.asarray(cameras.viewmat, np.float64)
    centres, target = camera_centres(viewmats), centre_of_attention(cameras, depth)
    central = _most_central(centres)
    axes, distance = viewmats[central, :3, :3], float(np.linalg.norm(target - centres[central]))
    spread = np.percentile(np.abs((centres - centres[central]) @ axes.T), 90, axis=0)
    reach = np.clip(spread, distance * np.array([0.05, 0.05, 0]), distance * np.array([0.25, 0.25, 0.1]))
    phase = np.linspace(0, 4 * np.pi, len(times))
    offsets = reach * np.stack([np.cos(phase), -np.sin(phase), -np.sin(0.5 * phase)], axis=-1)
    places = centres[central] + offsets @ axes
    return _cameras(_looking_at(target, places, -axes[1]), places, np.asarray(cameras.K[central]), times, cameras)


def orbit(cameras: Camera, depth: float, times: Float[np.ndarray, " T"]) -> Camera:
    """Around the centre of attention at the trained views' distance and height, looking at it.

    Once around where the trained views stand on all sides; else to and fro between the outermost of them, because
    nobody has seen the scene from behind.

    Args:
        cameras: F trained views in any order.
        depth: how far away the scene is, world units (`median_depth`).
        times: instants of the cameras to return, in [0, 1].
    """
    viewmats = np.asarray(cameras.viewmat, np.float64)
    centres, target = camera_centres(viewmats), centre_of_attention(cameras, depth)
    central = _most_central(centres)
    up = mean_up(viewmats)
    heights = (centres - target) @ up
    level = centres - target - np.outer(heights, up)
    radii = np.linalg.norm(level, axis=-1)
    ahead = level[radii.argmax()] / radii.max()
    beside = np.cross(up, ahead)

    angles = np.sort(np.arctan2(level @ beside, level @ ahead))
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    phase = np.linspace(0, 2 * np.pi, len(times))
    if gaps.max() > ALL_AROUND:
        first = angles[(gaps.argmax() + 1) % len(angles)]
        half = (2 * np.pi - gaps.max()) / 2
        phase = first + half + max(half, 0.1) * np.sin(phase)  # a tripod's views sway a little, too
    circle = np.outer(np.cos(phase), ahead) + np.outer(np.sin(phase), beside)
    places = target + np.median(heights) * up + np.median(radii) * circle
    return _cameras(_looking_at(target, places, up), places, np.asarray(cameras.K[central]), times, cameras)


def centre_of_attention(cameras: Camera, depth: float) -> Float[np.ndarray, "3"]:
    """The point that cameras look at, world units: nearest to their optical axes, and about `depth` away.

    The axes of cameras that look the same way meet nowhere in particular. A tenth of the weight, which is little where
    they do meet, draws it to the points that lie `depth` away on each.
    """
    viewmats = np.asarray(cameras.viewmat, np.float64)
    centres, forward = camera_centres(viewmats), viewmats[:, 2, :3]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    ahead = centres + depth * forward
    return np.linalg.solve(
        (across + 0.1 * np.eye(3)).sum(0), (np.einsum("fij,fj->fi", across, centres) + 0.1 * ahead).sum(0)
    )


def _looking_at(
    target: Float[np.ndarray, "3"], places: Float[np.ndarray, "T 3"], up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "T 3 3"]:
    """World-to-camera rotations of cameras at `places` that see `target` in the middle and `up` upwards."""
    forward = target - places
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _cameras(
    rotations: Float[np.ndarray, "T 3 3"],
    centres: Float[np.ndarray, "T 3"],
    K: Float[np.ndarray, "*T 3 3"],
    times: Float[np.ndarray, " T"],
    like: Camera,
) -> Camera:
    viewmat = np.tile(np.eye(4), (len(times), 1, 1))
    viewmat[:, :3, :3] = rotations
    viewmat[:, :3, 3] = -np.einsum("tij,tj->ti", rotations, centres)
    intrinsics = np.broadcast_to(K, (len(times), 3, 3))
    path: list[Any] = [x.astype(like.viewmat.dtype) for x in (viewmat, intrinsics, times)]
    return Camera(*path)


def _most_central(centres: Float[np.ndarray, "F 3"]) -> int:
    """The one that is nearest to all others in the mean."""
    return int(cdist(centres, centres).sum(0).argmin())


def _bandwidth(times: Float[np.ndarray, " F"]) -> float:
    """Of the weights with which views are averaged: a part of the whole duration, and never less than a few views."""
    return max(0.04, 1.5 / len(times))


def _nearby(at: Float[np.ndarray, " A"], times: Float[np.ndarray, " F"], bandwidth: float) -> Float[np.ndarray, "A F"]:
    """Gaussian weights of the views around each instant; rows sum to 1."""
    exponent = -0.5 * ((at[:, None] - times[None]) / bandwidth) ** 2
    weights = np.exp(exponent - exponent.max(-1, keepdims=True))
    return weights / weights.sum(-1, keepdims=True)


def _rms(offsets: Float[np.ndarray, "F 3"]) -> float:
    return float(np.sqrt((offsets**2).sum(-1).mean()))
