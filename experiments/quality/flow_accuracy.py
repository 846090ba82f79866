"""How well frames follow from their neighbours: `python -m experiments.quality.flow_accuracy SCENE... [--downscale K]`.

With `--json FILE`, the numbers of all scenes are written as well.

Every second frame is synthesised from those before and after it, as training synthesises views between frames. A pixel
is right if it differs from the true frame by less than three times the median difference, after blurring both by a
pixel. Only moving pixels count, by the masks of the scene or, if it has none, by computed ones.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from experiments.markdown import percentages
from l2dgs_jax.data import Split, load_dataset
from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.motion_masks import compute_masks
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import write_json
from l2dgs_jax.training.flows import neighbour_flows
from l2dgs_jax.training.inbetweens import draw
from l2dgs_jax.types import Camera

RIGHT_BELOW = 3.0  # times the median difference


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    accuracies: dict[str, dict[str, float]] = {}
    for scene in options.scenes:
        dataset = load_dataset(scene, options.downscale)
        split = dataset.train
        moving = compute_masks(dataset)[: len(split.names)] if split.masks is None else split.masks
        order = np.argsort(split.cameras.time, kind="stable")
        if not moving[order[1:-1:2]].any():
            raise UserError(f"{scene}: nothing moves in it; expected moving pixels between two frames")
        accuracies[dataset.name] = {}
        for flow, filled in (("by patches", False), ("with smooth flow", True)):
            for outcome, share in zip(("right", "wrong"), shares(split, moving, order, filled), strict=True):
                accuracies[dataset.name][f"{outcome}, {flow}"] = round(float(share), 4)
    sys.stdout.write(percentages(accuracies))
    if options.json:
        write_json(options.json, accuracies)


def shares(split: Split, moving: Bool[np.ndarray, "F H W"], order: np.ndarray, filled: bool) -> np.ndarray:
    """Shares of the moving pixels that are right and wrong, the mean over the synthesised frames."""
    kept = order[::2]
    few = _some(split, kept)
    flows = neighbour_flows(few, filled=filled)
    times, found = split.cameras.time, []
    for index, middle in enumerate(order[1 : 2 * len(kept) - 2 : 2]):
        first, second = kept[index : index + 2]
        part = float((times[middle] - times[first]) / (times[second] - times[first]))
        view = draw(few, flows, index, part)
        apart = np.abs(_blurred(view.image) - _blurred(split.images[middle])).mean(-1)
        right = apart < RIGHT_BELOW * np.median(apart[view.valid])
        counted = moving[middle]
        if counted.any():
            found.append([(view.valid & is_so & counted).sum() / counted.sum() for is_so in (right, ~right)])
    return np.mean(found, axis=0)


def _some(split: Split, frames: np.ndarray) -> Split:
    cameras = Camera(*(np.asarray(x)[frames] for x in split.cameras))
    return Split(tuple(split.names[frame] for frame in frames), cameras, split.images[frames])


def _blurred(image: np.ndarray) -> Float32[np.ndarray, "H W 3"]:
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0)


if __name__ == "__main__":
    command_line.run(main)
