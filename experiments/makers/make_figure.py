"""Make the README's picture of a run: `python -m experiments.makers.make_figure RUN OUTPUT.png [--views N]`.

It has a row for each held-out view: the dark input, our estimate of it, the well-lit scene.
"""

import argparse
from pathlib import Path

import cv2
import jax
import numpy as np

from l2dgs_jax import open_run
from l2dgs_jax.data.images import to_bytes, write_image
from l2dgs_jax.data.stacks import evenly_spread

GAP = 6  # pixels


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--views", type=int, default=2)
    options = parser.parse_args()

    run = open_run(options.run)
    split, renderer = run.dataset.test, run.renderer()
    rows = []
    for i in evenly_spread(len(split.names), options.views + 2)[1:-1].tolist():
        images = jax.device_get(renderer(split.camera(i))).images
        pictures = [to_bytes(x) for x in (split.images[i], images.lowlight, images.welllit)]
        rows.append(np.hstack([np.pad(p, ((0, GAP), (0, GAP), (0, 0)), constant_values=255) for p in pictures]))
    figure = np.vstack(rows)[:-GAP, :-GAP]
    write_image(options.output, cv2.resize(figure, None, fx=1.25, fy=1.25, interpolation=cv2.INTER_CUBIC))


if __name__ == "__main__":
    main()
