"""The `camera_path.json` of nerfstudio: cameras to render, as its viewer writes them.

    [render_width, render_height]   of the images, pixels
    [fps]                           frames a second
    camera_path                     for each camera: camera_to_world (16 numbers, row by row; axes right, up, back),
                                    fov (vertical, degrees) and [render_time] or [time] in [0, 1]

Fields in brackets are optional; all others are for nerfstudio's viewer only and ignored.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from l2dgs_jax.data.parsing import numbers, read_json, value
from l2dgs_jax.data.transforms import world_to_camera
from l2dgs_jax.errors import UserError
from l2dgs_jax.types import Camera

_TIMES = ("render_time", "time")


class CameraPath(NamedTuple):
    """Cameras of a file, and the size and frame rate of the images to render.

    Attributes:
        cameras: NumPy float32 arrays; time runs evenly from 0 to 1 if the file does not say it.
        size: width and height of the images that `K` is for, pixels.
        fps: frames per second, if the file says it.
    """

    cameras: Camera
    size: tuple[int, int]
    fps: float | None


def read_camera_path(path: Path, size: tuple[int, int]) -> CameraPath:
    """Read a camera path, which must be in the coordinates of the scene's cameras.

    Args:
        path: the file.
        size: width and height of the images if the file does not say it, pixels.

    Raises:
        UserError: the file is missing or malformed, or has no cameras or other than perspective ones.
    """
    content = read_json(path, "nerfstudio's camera path")
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise UserError(f"{path}: 'camera_type' is {kind!r}; expected 'perspective'")
    entries = value(path, content, "camera_path", list)
    if not entries or not all(isinstance(entry, dict) for entry in entries):
        raise UserError(f"{path}: 'camera_path' is no list of cameras; expected at least one, each a JSON object")
    if "render_width" in content or "render_height" in content:
        size = int(numbers(path, content, "render_width", ())), int(numbers(path, content, "render_height", ()))
    fps = float(numbers(path, content, "fps", ())) if content.get("fps") is not None else None
    timed = any(entry.get(key) is not None for entry in entries for key in _TIMES)

    poses, intrinsics, times = [], [], np.linspace(0, 1, len(entries))
    for i, entry in enumerate(entries):
        source = f"{path}, camera {i + 1} of {len(entries)}"
        matrix = numbers(source, entry, "camera_to_world", (16,)).reshape(4, 4)
        poses.append(world_to_camera(source, "camera_to_world", matrix))
        intrinsics.append(_intrinsics(source, entry, size))
        if timed:
            times[i] = _time(source, entry)
    arrays: list[Any] = [np.asarray(x, np.float32) for x in (poses, intrinsics, times)]
    return CameraPath(Camera(*arrays), size, fps)


def _intrinsics(source: str, entry: dict[str, Any], size: tuple[int, int]) -> Float64[np.ndarray, "3 3"]:
    fov = float(numbers(source, entry, "fov", ()))
    if not 0 < fov < 180:
        raise UserError(f"{source}: 'fov' is {fov:g}; expected degrees between 0 and 180")
    width, height = size
    focal = height / 2 / np.tan(np.radians(fov) / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def _time(source: str, entry: dict[str, Any]) -> float:
    key = next((key for key in _TIMES if entry.get(key) is not None), _TIMES[0])
    time = float(numbers(source, entry, key, ()))
    if not 0 <= time <= 1:
        raise UserError(f"{source}: '{key}' is {time:g}; expected an instant from 0 to 1")
    return time
