"""`python -m experiments.lowlight OUT [--scenes SCENE ...]`: how well the low-light input is explained (section 5).

Scores are of the estimate of held-out low-light views against these views: by scene, and their mean with the paper's in
brackets. OUT/lowlight.md has the table, OUT/lowlight.json the same numbers.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro

from experiments.published import LOWLIGHT, Cells
from experiments.tables import Options, means, table, trained, write
from l2dgs_jax.runtime import command_line


def main(arguments: Sequence[str]) -> None:
    options = tyro.cli(Options, args=arguments)
    found = collect(trained(options, "lowlight.toml"))
    write(options, "lowlight", {"scenes": found, "paper": LOWLIGHT}, markdown(found))


def collect(members: Sequence[dict[str, Any]]) -> dict[str, Cells]:
    """Mean scores over the seeds, by scene."""
    groups: dict[str, list[Cells]] = {}
    for member in members:
        scores = member["scores"]
        regions = scores.get("lowlight_regions", {}) | {"overall": scores["lowlight"]}
        groups.setdefault(Path(member["scene"]).name, []).append(regions)
    return {scene: means(cells) for scene, cells in groups.items()}


def markdown(found: dict[str, Cells]) -> str:
    rows: list[tuple[str, Sequence[Cells]]] = [(scene, [cells]) for scene, cells in found.items()]
    return table([*rows, ("mean", [means(found.values()), LOWLIGHT])])


if __name__ == "__main__":
    command_line.run(main, sys.argv[1:], huge_pages=True)
