"""`python -m l2dgs_jax.evaluate RUN`: how well the views of a run match the input and, where known, the truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from l2dgs_jax.errors import UserError
from l2dgs_jax.runs import open_run
from l2dgs_jax.runs.scores import evaluate, table
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import write_json


@dataclass(frozen=True)
class Evaluate:
    """Score every view of a split.

    Attributes:
        run: folder of the run.
        split: which views.
        json: file to write the scores to.
        stage: the last checkpoint, or the one at the end of the coarse stage.
    """

    run: tyro.conf.Positional[Path]
    split: Literal["test", "train"] = "test"
    json: Path | None = None
    stage: Literal["final", "coarse"] = "final"


def main(arguments: Sequence[str]) -> None:
    """Evaluate as the command line says."""
    options = command_line.parse(Evaluate, arguments, "evaluate")
    if options.json and (options.json.is_dir() or not options.json.parent.is_dir()):
        raise UserError(f"--json {options.json}: cannot be written; expected a file in an existing folder")
    result = evaluate(open_run(options.run, options.stage), options.split)
    print(table(result))
    if options.json:
        write_json(options.json, result)


if __name__ == "__main__":
    command_line.run(main, huge_pages=True)
