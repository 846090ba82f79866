"""`python -m l2dgs_jax.convert SCENE OUT --to LAYOUT`: write a scene in another program's layout."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from l2dgs_jax.config import Layout, LayoutName
from l2dgs_jax.data import LAYOUTS, load_dataset
from l2dgs_jax.runtime import command_line


@dataclass(frozen=True)
class Convert:
    """Write a scene in another layout, with 8-bit pictures and without lens distortion.

    Attributes:
        scene: folder of the scene, or "demo" for the clip that comes with the package.
        output: folder to create.
        to: layout to write.
        format: layout of the scene's folder; "auto" recognises it from its contents.
        downscale: integer factor by which to shrink the pictures.
        held_out: views to mark as held out: "auto" (the scene's own), "4dgs", or a number k for every k-th frame
            (docs/data.md).
    """

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    output: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    to: LayoutName
    format: Layout = "auto"
    downscale: int = 1
    held_out: str = "auto"


def main(arguments: Sequence[str]) -> None:
    """Convert as the command line says."""
    options = command_line.parse(Convert, arguments, "convert")
    # the world as it is stored, because some presets train in it
    dataset = load_dataset(options.scene, options.downscale, options.format, options.held_out, normalise=False)
    for note in dataset.notes:
        print(f"note: {note}")
    LAYOUTS[options.to].write(dataset, options.output)
    count = len(dataset.train.names) + len(dataset.test.names)
    print(
        f"wrote {count} frames of {dataset.width}x{dataset.height} and {len(dataset.points)} points to {options.output}"
    )


if __name__ == "__main__":
    command_line.run(main)
