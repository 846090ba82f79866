"""Warnings that a user should get before a long training."""

import math

from l2dgs_jax.cameras import camera_extent, median_depth
from l2dgs_jax.config import Config
from l2dgs_jax.data import Dataset

USUAL_PIXELS = 90_000  # of a frame: 400x225
MANY_PIXELS = 250_000
FEW_POINTS = 500
FEW_FRAMES = 8
STILL = 0.01  # extent of the camera's path over median depth; that of a hand-held camera is about 0.25


def misfit(dataset: Dataset, config: Config) -> str | None:
    """One sentence on the costliest mismatch between scene and settings; None if there is none."""
    cameras = dataset.train.cameras
    if config.model.unit == "world" and camera_extent(cameras) < STILL * median_depth(cameras, dataset.points):
        return (
            "the camera hardly moves, and with --model.unit world little is learned then, as learning rates scale with "
            "the extent of its path; --model.unit depth scales them with the depth of the scene"
        )
    pixels = dataset.width * dataset.height
    if pixels > MANY_PIXELS:
        factor = math.ceil(math.sqrt(pixels / MANY_PIXELS))
        return (
            f"frames of {dataset.width}x{dataset.height} take about {pixels / USUAL_PIXELS:.0f} times as long as ones "
            f"of 400x225; --downscale {factor * config.downscale} makes them smaller"
        )
    if len(dataset.train.names) < FEW_FRAMES:
        return f"{len(dataset.train.names)} frames are few to learn motion from; expect it to be coarse"
    grows = config.density.start < config.density.stop
    if len(dataset.points) < FEW_POINTS and not (grows or config.model.surfaces):
        return f"{len(dataset.points)} points are few and none are added; expect blur, or add some (--density.stop)"
    if len(dataset.points) > int(config.density.max_gaussians):
        return (
            f"of {len(dataset.points)} points only {config.density.max_gaussians} are used, as many as there may be "
            "Gaussians; --density.max-gaussians allows more, which take more time and memory"
        )
    return None
