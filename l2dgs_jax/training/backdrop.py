"""The backdrop: what lies behind moving things, as far as the scene's points tell before training."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial import cKDTree

from l2dgs_jax.cameras.geometry import camera_centres, pixel_rays, project_points
from l2dgs_jax.cameras.ground import TOLERANCE, Ground, find_ground, ground_depths
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera

DEPTH_CELL = 4  # side in pixels of a square that has one depth
NEIGHBOURS = 30  # nearest points of a pixel that depths are taken from
STATIC_QUANTILES = 0.03, 0.97  # of their depths, between which static surfaces may lie: a few points are outliers
CANDIDATES = 4  # depths in that range, evenly spaced in inverse depth
BORDER = 0.1  # distance from the picture within which points still count, in focal lengths
ON_GROUND = 0.8  # a surface is taken for the ground from this share of the ground's depth there up to its inverse


class Cameras(NamedTuple):
    """A `Camera` of F frames in NumPy arrays of double precision."""

    viewmat: Float[np.ndarray, "F 4 4"]
    K: Float[np.ndarray, "F 3 3"]
    time: Float[np.ndarray, " F"]


class Depths(NamedTuple):
    """Depths that the points around each cell of F frames suggest, world units; NaN in frames that show no points.

    Attributes:
        still: C candidates for static surfaces, the nearest first.
        hidden: of the surface that something there would hide.
    """

    still: Float32[np.ndarray, "C *F h w"]
    hidden: Float32[np.ndarray, "*F h w"]


class Backdrop(NamedTuple):
    """What F frames would show if nothing moved.

    Attributes:
        cameras: of the frames.
        depths: in their cells.
        ground: None if the points show none.
    """

    cameras: Cameras
    depths: Depths
    ground: Ground | None

    def of(self, frames: Int[np.ndarray, " N"]) -> "Backdrop":
        """That of some of the frames."""
        depths = Depths(self.depths.still[:, frames], self.depths.hidden[frames])
        return Backdrop(Cameras(*(x[frames] for x in self.cameras)), depths, self.ground)


def find_backdrop(
    points: Float[np.ndarray, "P 3"], camera: Camera, height: int, width: int, tolerance: float = TOLERANCE
) -> Backdrop:
    """The backdrop of frames of that size, of points in world units; `tolerance` is that of `find_ground`."""
    cameras = Cameras(*(np.asarray(x, np.float64) for x in camera))
    frames = range(len(cameras.time))
    around = prefetch(lambda i: depths_around(points, cameras.viewmat[i], cameras.K[i], height, width), frames)
    still, hidden = zip(*around, strict=True)
    depths = Depths(np.stack(still, axis=1), np.stack(hidden))
    return Backdrop(cameras, depths, find_ground(points, cameras.viewmat, tolerance))


def depths_around(
    points: Float[np.ndarray, "P 3"],
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    height: int,
    width: int,
) -> Depths:
    """Depths in one frame, of points in world units."""
    pixels, depth = project_points(points, viewmat, K)
    border = BORDER * K[0, 0]
    inside = ((pixels > -border) & (pixels < (width + border, height + border))).all(-1)
    rows, columns = (np.arange(0, size, DEPTH_CELL) + 0.5 * DEPTH_CELL for size in (height, width))
    if not inside.any():
        unknown = np.full((1 + CANDIDATES, len(rows), len(columns)), np.nan, np.float32)
        return Depths(unknown[1:], unknown[0])
    cells = np.stack(np.meshgrid(columns, rows), axis=-1)
    _, around = cKDTree(pixels[inside]).query(cells, k=range(1, min(NEIGHBOURS, int(inside.sum())) + 1))
    low, high = STATIC_QUANTILES
    near, median, far = np.quantile(depth[inside][around], (low, 0.5, high), axis=-1)
    return Depths((1 / np.linspace(1 / near, 1 / far, CANDIDATES)).astype(np.float32), median.astype(np.float32))


def depths_at(
    depths: Float32[np.ndarray, "F h w"], frames: Int[np.ndarray, " O"], pixels: Float[np.ndarray, "O 2"]
) -> Float32[np.ndarray, " O"]:
    """Depths of the cells that pixels lie in."""
    columns, rows = (pixels // DEPTH_CELL).astype(int).T
    return depths[frames, rows, columns]


def hidden_depths(
    backdrop: Backdrop, frames: Int[np.ndarray, " O"], pixels: Float[np.ndarray, "O 2"]
) -> Float[np.ndarray, " O"]:
    """Depths of the surfaces that something at those pixels would hide, world units; NaN where unknown."""
    floor = floor_depths(backdrop, frames, pixels)
    return np.where(np.isnan(floor), depths_at(backdrop.depths.hidden, frames, pixels), floor)


def floor_depths(
    backdrop: Backdrop, frames: Int[np.ndarray, " O"], pixels: Float[np.ndarray, "O 2"]
) -> Float[np.ndarray, " O"]:
    """The same where the surface is the ground, whose plane tells its depth better, and NaN elsewhere.

    If there is no ground, any surface may be one that things stand on.
    """
    hidden = depths_at(backdrop.depths.hidden, frames, pixels).astype(np.float64)
    if backdrop.ground is None:
        return hidden
    viewmat, K, _ = backdrop.cameras
    ground = ground_depths(pixels, viewmat[frames], K[frames], backdrop.ground)
    return np.where((ON_GROUND * ground <= hidden) & (ON_GROUND * hidden < ground), ground, np.nan)


def unprojected(
    cameras: Cameras, frames: Int[np.ndarray, " O"], pixels: Float[np.ndarray, "O 2"], depths: Float[np.ndarray, " O"]
) -> Float[np.ndarray, "O 3"]:
    """World points at those depths."""
    viewmat, K = cameras.viewmat[frames], cameras.K[frames]
    return camera_centres(viewmat) + depths[:, None] * pixel_rays(pixels, viewmat, K)
