"""Make a picture of several methods: `python -m experiments.makers.make_methods_figure OUTPUT.jpg NAME=RUN ...`.

It has a row for each of a few held-out views, and columns for the dark input, the well-lit image of every run, and the
truth. All runs are of the same scene.
"""

import argparse
from pathlib import Path

import jax

from l2dgs_jax import open_run
from l2dgs_jax.data.images import encode_jpeg, to_bytes
from l2dgs_jax.data.stacks import evenly_spread
from l2dgs_jax.visualize.sheet import sheet

JPEG_QUALITY = 90


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("runs", nargs="+", metavar="NAME=RUN")
    parser.add_argument("--views", type=int, default=3)
    options = parser.parse_args()

    runs = {name: open_run(folder) for name, folder in (text.split("=", 1) for text in options.runs)}
    split = next(iter(runs.values())).dataset.test
    chosen = evenly_spread(len(split.names), options.views + 2)[1:-1].tolist()
    columns = {"input": [split.images[i] for i in chosen]}
    for name, run in runs.items():
        renderer = run.renderer()
        columns[name] = [jax.device_get(renderer(split.camera(i)).images.welllit) for i in chosen]
    columns["truth"] = [split.welllit[i] for i in chosen]
    captions = (f"{split.names[i]}, time {split.cameras.time[i]:.2f}" for i in chosen)
    rows = zip(*columns.values(), strict=True)
    picture = sheet(list(columns), [(text, list(map(to_bytes, row))) for text, row in zip(captions, rows, strict=True)])
    options.output.write_bytes(encode_jpeg(picture, JPEG_QUALITY))


if __name__ == "__main__":
    main()
