"""`python -m l2dgs_jax.render RUN`: the held-out views as images, with their decomposition and depth."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import numpy as np
import tyro
from tqdm import tqdm

from l2dgs_jax import cli, runs
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.images import to_bytes, write_image
from l2dgs_jax.errors import UserError
from l2dgs_jax.files import replacing
from l2dgs_jax.runs import Run
from l2dgs_jax.threads import in_order
from l2dgs_jax.types import RenderOutput
from l2dgs_jax.visualize import expected_depth, view

KINDS = ("welllit", "lowlight", "illumination", "reflectance", "depth")


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


def render(arguments: Sequence[str]) -> None:
    """Render as the command line says."""
    options = cli.parse(Render, arguments, "render")
    run = runs.open_run(options.run, options.stage)
    split = choose_split(run, options.split)
    base = options.output or options.run / ("renders" if options.stage == "final" else "renders_coarse")
    write_views(run, split, base / options.split)
    print(f"wrote {len(split.names)} views to {base / options.split}")


def write_views(run: Run, split: Split, folder: Path) -> None:
    """Render every view of `split` into `folder`, laid out as `Render` says.

    Raises:
        UserError: a file cannot be written.
    """
    for kind in KINDS:
        for name in split.names:
            _make_folder((folder / kind / name).parent)
    depths = []
    for name, output in zip(split.names, views(run, split), strict=True):
        for kind in KINDS[:-1]:
            write_image(folder / kind / f"{name}.png", to_bytes(getattr(output.images, kind)))
        depths.append(expected_depth(output))

    # One unit for all views, so that the depth of a video does not flicker.
    unit = max(float(max(depth.max() for depth in depths)), 1e-12) / 65535
    for name, depth in zip(split.names, depths, strict=True):
        write_image(folder / "depth" / f"{name}.png", np.round(depth / unit).astype(np.uint16))
    with replacing(folder / "depth.json") as temporary:
        temporary.write_text(json.dumps({"unit": unit, "meaning": "depth = value * unit, 0 where empty"}) + "\n")


def views(run: Run, split: Split) -> Iterator[RenderOutput]:
    """Render the views of `split` in order, as NumPy arrays, showing progress."""
    renderer = run.renderer()
    outputs = in_order(lambda i: jax.device_get(renderer(view(split.cameras, i))), range(len(split.names)))
    yield from tqdm(outputs, total=len(split.names), desc="render", unit="view", dynamic_ncols=True)


def choose_split(run: Run, name: str) -> Split:
    """The run's "test" or "train" views.

    Raises:
        UserError: there are none.
    """
    split: Split = getattr(run.dataset, name)
    if not len(split.names):
        raise UserError(f"{run.folder}: its scene has no {name} views; expected some, or --split train")
    return split


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made ({error.strerror}); expected a folder to write to") from None


if __name__ == "__main__":
    cli.main(render, huge_pages=True)
