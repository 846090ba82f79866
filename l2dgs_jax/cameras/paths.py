"""Camera paths, as batches of cameras in NumPy arrays of the same type as the trained views'."""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from l2dgs_jax.cameras.geometry import camera_centres, mean_up
from l2dgs_jax.types import Camera

MAX_AZIMUTH_GAP = np.radians(120)  # cameras surround a scene if none of the gaps between neighbours is wider


def space_time_path(cameras: Camera, frames: int) -> Camera:
    """A smooth path along the trained views: time rests at 0 for a quarter of it, then runs from 0 to 1.

    It is that of `interpolate` plus a gentle sway within the image plane.

    Args:
        cameras: F trained views in any order.
        frames: how many cameras to return.
    """
    resting = frames // 4
    path = interpolate(cameras, np.concatenate([np.zeros(resting), np.linspace(0, 1, frames - resting)]))
    centres = camera_centres(np.asarray(cameras.viewmat, np.float64))
    phase = np.linspace(0, 4 * np.pi, frames)
    sway = 0.2 * _rms(centres - centres.mean(0)) * np.stack([np.sin(phase), 0.3 * np.sin(2 * phase)], axis=-1)
    path.viewmat[:, :2, 3] -= sway
    return path


def interpolate(cameras: Camera, times: Float[np.ndarray, " T"]) -> Camera:
    """The path of the trained views, smoothed to remove the shake of the hand.

    The pose at an instant is the Gaussian-weighted mean of the views around it. Where the views jump about from frame
    to frame, their mean would not be a sensible pose: the pose of the most central view is used throughout.

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
    weights = _temporal_weights(times, trained, bandwidth)
    orientations = np.stack([Rotation.from_matrix(rotations).mean(w).as_matrix() for w in weights])
    return _cameras(orientations, weights @ centres, np.einsum("tf,fij->tij", weights, intrinsics), times, cameras)


def is_path(cameras: Camera) -> bool:
    """Whether the views form a continuous path, instead of jumping about from frame to frame."""
    trained = np.asarray(cameras.time, np.float64)
    centres = camera_centres(np.asarray(cameras.viewmat, np.float64))
    deviations = centres - _temporal_weights(trained, trained, _bandwidth(trained)) @ centres
    return _rms(deviations) <= 0.5 * _rms(centres - centres.mean(0))


def spiral(cameras: Camera, depth: float, times: Float[np.ndarray, " T"]) -> Camera:
    """Two turns around the most central view, looking at the centre of attention (as LLFF, arXiv 1905.00889).

    They are as wide as the trained views spread, within bounds that show some parallax and keep the scene in view.

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

    Once around if the trained views surround the scene; otherwise to and fro between the outermost of them, because no
    view has seen the scene from behind.

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
    if gaps.max() > MAX_AZIMUTH_GAP:
        first = angles[(gaps.argmax() + 1) % len(angles)]
        half = (2 * np.pi - gaps.max()) / 2
        phase = first + half + max(half, 0.1) * np.sin(phase)  # a tripod's views sway a little, too
    circle = np.outer(np.cos(phase), ahead) + np.outer(np.sin(phase), beside)
    places = target + np.median(heights) * up + np.median(radii) * circle
    return _cameras(_looking_at(target, places, up), places, np.asarray(cameras.K[central]), times, cameras)


def centre_of_attention(cameras: Camera, depth: float) -> Float[np.ndarray, "3"]:
    """The point that cameras look at, world units: nearest to their optical axes, and about `depth` away.

    Nearly parallel axes do not determine such a point. So the points at `depth` on each axis attract it, too, with a
    tenth of the weight, which matters little where the axes do meet.
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
    """Standard deviation in time of the weights of `_temporal_weights`: 0.04, or more if there are few views."""
    return max(0.04, 1.5 / len(times))


def _temporal_weights(
    at: Float[np.ndarray, " A"], times: Float[np.ndarray, " F"], bandwidth: float
) -> Float[np.ndarray, "A F"]:
    """Gaussian weights of the views around each instant; rows sum to 1."""
    exponent = -0.5 * ((at[:, None] - times[None]) / bandwidth) ** 2
    weights = np.exp(exponent - exponent.max(-1, keepdims=True))
    return weights / weights.sum(-1, keepdims=True)


def _rms(offsets: Float[np.ndarray, "F 3"]) -> float:
    return float(np.sqrt((offsets**2).sum(-1).mean()))
