"""Camera paths as nerfstudio's viewer saves them and `ns-render camera-path` reads them."""

from typing import Any

import numpy as np

from l2dgs_jax.cameras.geometry import OPENGL_AXES
from l2dgs_jax.types import Camera


def camera_path(cameras: Camera, width: int, height: int, fps: int) -> dict[str, Any]:
    """The content of a `camera_path.json`: cameras in the order of their instants, in unchanged world coordinates.

    The format has only the vertical field of view, in degrees, and neither principal points nor pixels that are not
    square.

    Args:
        cameras: F cameras.
        width: of their images, pixels.
        height: of their images, pixels.
        fps: frames per second at which the path is to be shown.
    """
    frames = []
    for i in np.argsort(cameras.time, kind="stable").tolist():
        pose = np.linalg.inv(np.asarray(cameras.viewmat[i], np.float64)) @ OPENGL_AXES
        frames.append(
            {
                "camera_to_world": pose.ravel().tolist(),
                "fov": float(np.degrees(2 * np.arctan(0.5 * height / cameras.K[i, 1, 1]))),
                "aspect": width / height,
                "render_time": float(cameras.time[i]),
            }
        )
    return {
        "camera_type": "perspective",
        "render_width": width,
        "render_height": height,
        "fps": fps,
        "seconds": len(frames) / fps,
        "keyframes": [],
        "camera_path": frames,
    }
