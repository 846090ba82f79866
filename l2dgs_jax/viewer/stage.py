"""Conversion between the cameras of a scene and those of a browser."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from l2dgs_jax.cameras import camera_centres, median_depth
from l2dgs_jax.types import Camera
from l2dgs_jax.viewer.ladder import Size


class Pose(NamedTuple):
    """A browser's camera, in units of the stage.

    Attributes:
        position: its centre.
        look_at: the point that it orbits.
        up: direction that is up in its picture.
        field: vertical field of view, radians.
    """

    position: Float[np.ndarray, "3"]
    look_at: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]
    field: float


class Stage(NamedTuple):
    """The scene's world in another unit of length, so that scenes of all sizes are at a similar distance.

    Attributes:
        unit: unit of length of the stage, world units.
        frame: width and height of the scene's own images, pixels.
    """

    unit: float
    frame: Size

    @classmethod
    def of(cls, cameras: Camera, points: Float[np.ndarray, "P 3"], frame: Size) -> "Stage":
        """The stage on which the points have a median depth of 1 in the cameras."""
        try:
            unit = median_depth(cameras, points)
        except ValueError:
            unit = 1.0
        return cls(unit, frame)

    def pose(self, camera: Camera, window: Size) -> Pose:
        """The browser's camera that sees what a camera of the scene sees, cropped to fill the window."""
        viewmat = np.asarray(camera.viewmat, np.float64)
        position = camera_centres(viewmat) / self.unit
        field = self.field(camera)
        wider = window[0] / window[1] / (self.frame[0] / self.frame[1])
        if wider > 1:
            field = 2 * math.atan(math.tan(field / 2) / wider)
        return Pose(position, position + viewmat[2, :3], -viewmat[1, :3], field)

    def field(self, camera: Camera) -> float:
        """The vertical field of view of a camera of the scene, radians."""
        return 2 * math.atan(self.frame[1] / (2 * float(camera.K[1, 1])))

    def camera(
        self,
        wxyz: Float[np.ndarray, "4"],
        position: Float[np.ndarray, "3"],
        field: float,
        window: Size,
        size: Size,
        time: float,
    ) -> Camera:
        """The camera of a picture that fills a browser's window.

        Args:
            wxyz: rotation from the camera's axes, which are OpenCV's, to those of the world.
            position: its centre, units of the stage.
            field: vertical field of view, radians.
            window: width and height of the window.
            size: width and height of the picture, pixels; its pixels are not square if it has another aspect ratio than
                the window.
            time: instant in [0, 1].
        """
        viewmat, K = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
        rotation = Rotation.from_quat(np.roll(wxyz, -1)).as_matrix().T
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ (self.unit * np.asarray(position))
        (width, height), tangent = size, math.tan(field / 2)
        K[0, 0], K[1, 1] = width / (2 * tangent * window[0] / window[1]), height / (2 * tangent)
        K[:2, 2] = width / 2, height / 2
        return Camera(viewmat, K, np.float32(time))  # type: ignore[arg-type]
