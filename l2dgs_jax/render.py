"""`python -m l2dgs_jax.render RUN`: the held-out views as images, with their decomposition and depth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from l2dgs_jax.runs import open_run
from l2dgs_jax.runs.pictures import write_views
from l2dgs_jax.runs.views import get_split
from l2dgs_jax.runtime import command_line


@dataclass(frozen=True)
class Render:
    """Render every view of a split: DIR/SPLIT/{welllit,lowlight,illumination,reflectance,depth}/NAME.png.

    Depth is 16-bit: a value v stands for v * unit, in the units of the scene's cameras, with the unit in
    DIR/SPLIT/depth.json; 0 means that nothing is there.

    Attributes:
        run: folder of the run.
        split: which views.
        output: folder to write to; RUN/renders if not given (RUN/renders_coarse for the coarse stage).
        stage: the last checkpoint, or the one at the end of the coarse stage.
    """

    run: tyro.conf.Positional[Path]
    split: Literal["test", "train"] = "test"
    output: Path | None = None
    stage: Literal["final", "coarse"] = "final"


def main(arguments: Sequence[str]) -> None:
    """Render as the command line says."""
    options = command_line.parse(Render, arguments, "render")
    run = open_run(options.run, options.stage)
    split = get_split(run, options.split)
    base = options.output or options.run / ("renders" if options.stage == "final" else "renders_coarse")
    write_views(run, split, base / options.split)
    print(f"wrote {len(split.names)} views to {base / options.split}")


if __name__ == "__main__":
    command_line.run(main, huge_pages=True)
