"""How well computed masks match a scene's own: `python -m experiments.quality.mask_accuracy SCENE [--downscale K]`.

The scene's own masks are the ground truth, and are not used for computing masks. Printed is the intersection over union
of the moving pixels, as the mean over the frames and over all pixels of all frames.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from l2dgs_jax.data import load_dataset
from l2dgs_jax.data.images import write_image
from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.motion_masks import compute_masks, preview
from l2dgs_jax.runtime import command_line


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--preview", type=Path)
    options = parser.parse_args(arguments)

    dataset = load_dataset(options.scene, options.downscale)
    if dataset.train.masks is None or dataset.test.masks is None:
        raise UserError(f"{options.scene}: has no masks of its own; expected some to compare computed ones with")
    begin = time.perf_counter()
    found = compute_masks(dataset)
    print(f"{time.perf_counter() - begin:.0f} s for {len(found)} frames of {dataset.width}x{dataset.height}")
    if options.preview:
        write_image(options.preview, preview(dataset, found))
    count = len(dataset.train.names)
    for name, split, mine in (("training", dataset.train, found[:count]), ("held out", dataset.test, found[count:])):
        common, either = ((f(mine, split.masks)).sum((1, 2)) for f in (np.logical_and, np.logical_or))
        ious = common / np.maximum(either, 1)
        print(
            f"{name}: IoU {ious.mean():.3f} (worst {ious.min():.3f}) as mean of {len(ious)} frames, "
            f"{common.sum() / either.sum():.3f} of all pixels; precision {common.sum() / max(mine.sum(), 1):.3f}, "
            f"recall {common.sum() / split.masks.sum():.3f}"
        )


if __name__ == "__main__":
    command_line.run(main)
