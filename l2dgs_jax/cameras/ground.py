"""The ground that things stand on, as far as the points of a scene show it, and distances along it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from l2dgs_jax.cameras.geometry import camera_centres, mean_up, pixel_rays

DRAWS = 2000  # planes through three random points each
COUNTED = 2000  # random points that vote for them
# Distance of a point from its plane, over the median distance of points from their median: of points from structure
# from motion, and of those from optical flow.
TOLERANCE, FLOW_TOLERANCE = 0.01, 0.03
MIN_SHARE = 0.1  # of the points that must lie on the ground
MAX_TILT = 55.0  # degrees between the ground's normal and the cameras' mean upward direction


class Ground(NamedTuple):
    """A level plane.

    Attributes:
        up: its unit normal.
        height: of its points along `up`, world units.
    """

    up: Float[np.ndarray, "3"]
    height: float


def find_ground(
    points: Float[np.ndarray, "P 3"], viewmats: Float[np.ndarray, "F 4 4"], tolerance: float = TOLERANCE
) -> Ground | None:
    """The plane that most points lie on; None if few do, or cameras are held otherwise.

    The plane is found by RANSAC and fitted to its points by least squares. The same points give the same plane.

    Args:
        points: of the scene, world units.
        viewmats: of the cameras.
        tolerance: see `TOLERANCE`.
    """
    if len(points) < 3:
        return None
    rng = np.random.default_rng(0)
    tolerance *= np.median(np.linalg.norm(points - np.median(points, axis=0), axis=-1))
    up = mean_up(viewmats)
    first, second, third = points[rng.integers(len(points), size=(3, DRAWS))]
    normals = np.cross(second - first, third - first)
    lengths = np.linalg.norm(normals, axis=-1)
    level = (lengths > 0) & (np.abs(normals @ up) > np.cos(np.radians(MAX_TILT)) * lengths)
    if not level.any():
        return None
    first, normals = first[level], normals[level] / lengths[level, None]
    voters = points[rng.permutation(len(points))[:COUNTED]]
    votes = (np.abs(normals @ voters.T - (normals * first).sum(-1)[:, None]) < tolerance).mean(-1)
    best = np.argmax(votes)
    if votes[best] < MIN_SHARE:
        return None
    on_ground = points[np.abs((points - first[best]) @ normals[best]) < tolerance]
    centre = on_ground.mean(0)
    normal = np.linalg.svd(on_ground - centre, full_matrices=False)[2][-1]
    normal *= np.sign(normal @ up)
    return Ground(normal, float(normal @ centre))


def ground_depths(
    pixels: Float[np.ndarray, "N 2"],
    viewmats: Float[np.ndarray, "N 4 4"],
    Ks: Float[np.ndarray, "N 3 3"],
    ground: Ground,
) -> Float[np.ndarray, " N"]:
    """Depths, in world units, at which the ground would be seen in pixels; infinite where it never is."""
    rise = pixel_rays(pixels, viewmats, Ks) @ ground.up
    below = ground.height - camera_centres(viewmats) @ ground.up
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = below / rise
    return np.where(depths > 0, depths, np.inf)


def horizontal_per_depth(
    pixels: Float[np.ndarray, "N 2"],
    viewmats: Float[np.ndarray, "N 4 4"],
    Ks: Float[np.ndarray, "N 3 3"],
    up: Float[np.ndarray, "3"],
) -> Float[np.ndarray, " N"]:
    """Distance along the camera's viewing direction, taken horizontally, of what a pixel shows at depth 1.

    Points above each other have the same horizontal distance, but different depths if the camera looks up or down. It
    is 0 or less where a ray leads straight down or backwards.
    """
    forward = viewmats[:, 2, :3]
    level = forward - np.outer(forward @ up, up)
    lengths = np.maximum(np.linalg.norm(level, axis=-1), np.finfo(float).tiny)
    return (pixel_rays(pixels, viewmats, Ks) * level).sum(-1) / lengths
