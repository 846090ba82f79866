"""The cameras to render of a run: the views of a split, a path through its scene, or those of a file."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from l2dgs_jax.cameras import median_depth, reframe
from l2dgs_jax.cameras.paths import interpolate, orbit, spiral
from l2dgs_jax.data.camera_path import read_camera_path
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runs.views import get_split
from l2dgs_jax.types import Camera

FLIGHTS = ("interpolate", "spiral", "orbit", "freeze-time", "freeze-camera")
DEFAULT_FPS = 24  # unless a file says otherwise


class Shots(NamedTuple):
    """Cameras to render, and names, size and frame rate of their images.

    Attributes:
        title: of all images: the name of their folder.
        names: of each image.
        cameras: a batch of NumPy arrays.
        size: width and height of the images that `K` is for, pixels.
        fps: frames per second of a video of them.
    """

    title: str
    names: tuple[str, ...]
    cameras: Camera
    size: tuple[int, int]
    fps: float | int = DEFAULT_FPS

    def resized(self, size: tuple[int, int]) -> "Shots":
        """The same cameras for images of another size, see `reframe`."""
        return self._replace(cameras=reframe(self.cameras, self.size, size), size=size)


def of_split(run: Run, name: str) -> Shots:
    """The run's "test" or "train" views.

    Raises:
        UserError: there are none.
    """
    split = get_split(run, name)
    return Shots(name, split.names, split.cameras, _size(run))


def of_flight(run: Run, flight: str, times: Float[np.ndarray, " T"], at: float) -> Shots:
    """A path through the scene.

    Args:
        run: the run.
        flight: one of `FLIGHTS`; "freeze-time" is the path of "interpolate" shown at the instant `at` throughout, and
            "freeze-camera" the camera of that path at the instant `at`, held still.
        times: instants of the cameras.
        at: instant in [0, 1], for "freeze-time" and "freeze-camera".
    """
    trained, still = run.dataset.train.cameras, np.full(len(times), at)
    if flight == "interpolate":
        cameras = interpolate(trained, times)
    elif flight == "freeze-time":
        cameras = interpolate(trained, times)._replace(time=still.astype(np.float32))  # type: ignore[arg-type]
    elif flight == "freeze-camera":
        cameras = interpolate(trained, still)._replace(time=times.astype(np.float32))  # type: ignore[arg-type]
    else:
        cameras = {"spiral": spiral, "orbit": orbit}[flight](trained, _depth(run), times)
    return Shots(flight, _numbered(len(times)), cameras, _size(run))


def of_file(run: Run, path: Path) -> Shots:
    """The cameras of a `camera_path.json`.

    Raises:
        UserError: it cannot be read or has no cameras.
    """
    cameras, size, fps = read_camera_path(path, _size(run))
    return Shots(path.stem, _numbered(len(cameras.time)), cameras, size, DEFAULT_FPS if fps is None else fps)


def _depth(run: Run) -> float:
    try:
        return median_depth(run.dataset.train.cameras, np.asarray(run.dataset.points))
    except ValueError as error:
        raise UserError(f"{run.name}: {error} of its scene; expected --path interpolate or a file") from None


def _size(run: Run) -> tuple[int, int]:
    return run.dataset.width, run.dataset.height


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(f"{i:06d}" for i in range(count))
