"""How far from the truth moving things start: `python -m experiments.quality.depth_accuracy SCENE... [--downscale K]`.

With `--json FILE`, the numbers of all scenes are written as well.

The scenes have well-lit frames, masks of what moves, and held-out views of the same instants from another place. Stereo
between a training and a held-out frame tells how far away the seeds in the training frame are. Only those count that
the masks show to lie on what moves. Printed are the median of the absolute error and the error's own median, for the
whole clip and for each sixth of it: a positive one means too far away.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32

from l2dgs_jax.cameras.epipolar import epipolar_geometry, project
from l2dgs_jax.cameras.flow import pixel_indices
from l2dgs_jax.cameras.geometry import points_inside
from l2dgs_jax.config import PRESETS
from l2dgs_jax.data import Split, load_dataset
from l2dgs_jax.data.dataset import Dataset
from l2dgs_jax.errors import UserError
from l2dgs_jax.model.deformation import path_weights
from l2dgs_jax.model.initialisation import Seeds, path_knots
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import write_json
from l2dgs_jax.training.seeds import find_seeds
from l2dgs_jax.types import Camera

SAME_TIME = 1e-4  # difference of times up to which two frames show the same instant
DEPTHS = 300  # candidates, evenly spaced in inverse depth
RANGE = 0.8, 1.5  # factors on the points' least and greatest inverse depth that bound the search
WINDOW = 7  # side in pixels of the square that is compared
MIN_CORRELATION = 0.8  # of its pixels, for a match to count
SMOOTH = 0.02  # relative difference from the median of 5x5 depths up to which a depth counts
PARTS = 6


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    accuracies = {}
    for scene in options.scenes:
        seen, full = load_dataset(scene, options.downscale), load_dataset(scene)
        if full.train.welllit is None or full.test.welllit is None or seen.train.masks is None:
            raise UserError(f"{scene}: lacks well-lit frames or masks; expected both, and views of the same instants")
        knots = path_knots(PRESETS["default"].model, len(seen.train.names))
        seeds = find_seeds(seen.points, seen.train, knots, most=seen.train.images[0, ..., 0].size)
        found = errors(seeds, seen.train, stereo(full))
        if not found:
            raise UserError(f"{scene}: no held-out view shows the instant of a training frame; expected some that do")
        together = np.concatenate(found)
        name = Path(scene).name
        print(f"{name}: {summary(together)}; by parts: {', '.join(map(summary, _parts(found)))}")
        accuracies[name] = {"whole clip": _median(together), "last sixth": _median(_parts(found)[-1])}
    if options.json:
        write_json(options.json, accuracies)


def _median(errors: Float[np.ndarray, " N"]) -> float | None:
    return round(float(np.median(np.abs(errors))), 5) if len(errors) else None


def summary(errors: Float[np.ndarray, " N"]) -> str:
    """The medians of an error and of its amount, which are differences of log-depths."""
    return f"{np.median(np.abs(errors)):.1%} ({np.median(errors):+.1%})" if len(errors) else "none"


def errors(seeds: Seeds, split: Split, depths: dict[int, Float32[np.ndarray, "h w"]]) -> list[Float[np.ndarray, " _"]]:
    """For each frame of known depth, log-depths of its seeds less the true ones."""
    height, width = split.images.shape[1:3]
    found = []
    for frame, depth in depths.items():
        time, viewmat, K = (np.asarray(x[frame], np.float64) for x in (split.cameras.time, *split.cameras[:2]))
        weights = np.asarray(path_weights(jnp.asarray(time)[None], seeds.paths.shape[1]))[0]
        alive = (seeds.lifetimes[:, 0] <= time) & (time <= seeds.lifetimes[:, 1])
        points = (seeds.points + np.einsum("k,nkc->nc", weights, seeds.paths))[alive]
        _, pixels, distances = points_inside(points.astype(np.float64), viewmat, K, (width, height))
        column, row = pixels.astype(int).T
        scaled = (pixels * (depth.shape[1] / width, depth.shape[0] / height)).astype(int)
        true = depth[np.minimum(scaled[:, 1], len(depth) - 1), np.minimum(scaled[:, 0], depth.shape[1] - 1)]
        counts = split.masks[frame][row, column] & np.isfinite(true)
        found.append(np.log(distances[counts] / true[counts]))
    return found


def stereo(dataset: Dataset) -> dict[int, Float32[np.ndarray, "H W"]]:
    """Depths of training frames, by their index, that a held-out frame shows at the same instant; NaN where unknown."""
    times, others = (np.asarray(split.cameras.time) for split in (dataset.train, dataset.test))
    nearest = np.abs(times - others[:, None]).argmin(1)
    pairs = [(first, second) for second, first in enumerate(nearest.tolist())]
    return {i: _depth(dataset, i, j) for i, j in sorted(pairs) if abs(times[i] - others[j]) < SAME_TIME}


def _depth(dataset: Dataset, first: int, second: int) -> Float32[np.ndarray, "H W"]:
    train, test = dataset.train, dataset.test
    cameras = Camera(*(np.stack([x[first], y[second]]) for x, y in zip(train.cameras, test.cameras, strict=True)))
    geometry = epipolar_geometry(cameras, 0, 1)
    here, there = (
        cv2.cvtColor(s.welllit[i].astype(np.float32), cv2.COLOR_RGB2GRAY) for s, i in ((train, first), (test, second))
    )
    *_, seen = points_inside(
        dataset.points.astype(np.float64), *(np.asarray(x[0], np.float64) for x in cameras[:2]), here.shape[::-1]
    )
    far, near = np.quantile(1 / seen, (0.005, 0.995))
    candidates = np.linspace(RANGE[0] * far, RANGE[1] * near, DEPTHS)
    pixels = pixel_indices(*here.shape) + np.float32(0.5)
    best, depth = np.full(here.shape, -1, np.float32), np.full(here.shape, np.nan, np.float32)
    for inverse in candidates:
        x, y = np.moveaxis(project(geometry, pixels, np.full(here.shape, inverse)).astype(np.float32) - 0.5, -1, 0)
        warped = cv2.remap(there, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=-1)
        alike = np.where(warped >= 0, _correlation(here, warped), -1)
        depth[alike > best] = 1 / inverse
        best = np.maximum(best, alike)
    median = cv2.medianBlur(np.nan_to_num(depth), 5)
    with np.errstate(divide="ignore", invalid="ignore"):
        agrees = np.abs(depth / median - 1) < SMOOTH
    return np.where((best > MIN_CORRELATION) & agrees, median, np.float32(np.nan))


def _correlation(first: Float32[np.ndarray, "H W"], second: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Of the squares around each pixel."""
    mean = lambda image: cv2.blur(image, (WINDOW, WINDOW))
    ours, theirs = mean(first), mean(second)
    spread = [np.maximum(mean(x * x) - m * m, 1e-5) for x, m in ((first, ours), (second, theirs))]
    return (mean(first * second) - ours * theirs) / np.sqrt(spread[0] * spread[1])


def _parts(found: list[Float[np.ndarray, " _"]]) -> list[Float[np.ndarray, " _"]]:
    groups = np.array_split(np.arange(len(found)), PARTS)
    return [np.concatenate([found[i] for i in group]) if len(group) else np.zeros(0) for group in groups]


if __name__ == "__main__":
    command_line.run(main)
