"""Make the packaged demo clip from a Nerfies scene: `python -m experiments.makers.make_demo SOURCE [--frames N]`.

It has the first N frames at half size, each pixel being the mean of a 2x2 block, with cameras and points; every eighth
frame is held out.
"""

import argparse
import json
import shutil
from pathlib import Path

import numpy as np

from l2dgs_jax.data import demo
from l2dgs_jax.data.images import area_average, read_image, to_bytes, write_image
from l2dgs_jax.runtime.files import write_json

FACTOR = 2
README = """# The demo clip

A hand moves over a dim bookshelf, filmed with a hand-held camera: {count} frames, {width}x{height}, Nerfies layout.

* Frames and poses: the example sequence of
  [nonrigid_nerf](https://github.com/facebookresearch/nonrigid_nerf), commit `ad24a1bb`, MIT licence (`LICENSE`).
* Changed here: the first {count} of its 86 frames at half size, poses in OpenCV axes, and surface points triangulated
  from the given poses with COLMAP. Made by `experiments/makers/make_demo.py`.
* There is no well-lit truth. Units are arbitrary. Every eighth frame, from the fifth, is held out.
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("--frames", type=int, default=44)
    options = parser.parse_args()
    make(options.source, demo.FOLDER, options.frames)


def make(source: Path, target: Path, frames: int) -> None:
    (target / "camera").mkdir(parents=True, exist_ok=True)
    (target / "rgb" / "1x").mkdir(parents=True, exist_ok=True)
    ids = json.loads((source / "dataset.json").read_text())["ids"][:frames]
    val_ids = ids[4::8]
    for name in ids:
        camera = json.loads((source / "camera" / f"{name}.json").read_text())
        camera["focal_length"] /= FACTOR
        camera["skew"] /= FACTOR
        camera["principal_point"] = [x / FACTOR for x in camera["principal_point"]]
        camera["image_size"] = [x // FACTOR for x in camera["image_size"]]
        write_json(target / "camera" / f"{name}.json", camera)
        image = area_average(read_image(source / "rgb" / "1x" / f"{name}.png"), FACTOR)
        write_image(target / "rgb" / "1x" / f"{name}.png", to_bytes(image))

    train_ids = [name for name in ids if name not in val_ids]
    lists = {"count": len(ids), "num_exemplars": len(train_ids)}
    write_json(target / "dataset.json", lists | {"ids": ids, "train_ids": train_ids, "val_ids": val_ids})
    metadata = json.loads((source / "metadata.json").read_text())
    write_json(target / "metadata.json", {name: metadata[name] for name in ids})
    for file in ("scene.json", "points_rgb.npy", "LICENSE"):
        shutil.copyfile(source / file, target / file)
    np.save(target / "points.npy", np.load(source / "points.npy").astype(np.float32))
    width, height = camera["image_size"]
    (target / "README.md").write_text(README.format(count=len(ids), width=width, height=height))


if __name__ == "__main__":
    main()
