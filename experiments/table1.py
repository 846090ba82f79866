"""`python -m experiments.table1 OUT [--scenes SCENE ...]`: methods by scenes and regions, as the paper's Table 1.

Scores are of held-out well-lit views. OUT/table1.md has a table for each scene, beside the paper's where it is one of
its scenes; OUT/table1.json the same numbers. PSNR after one global gain tells what is too dark from what is wrong.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro

from experiments.published import MEASURES, TABLE1, Cells
from experiments.tables import Options, means, table, trained, write
from l2dgs_jax.runtime import command_line

AFTER_GAIN = "psnr_gain"


def main(arguments: Sequence[str]) -> None:
    options = tyro.cli(Options, args=arguments)
    found = collect(trained(options, "table1.toml"))
    write(options, "table1", {"scenes": found, "paper": TABLE1}, markdown(found))


def collect(members: Sequence[dict[str, Any]]) -> dict[str, dict[str, Cells]]:
    """Mean scores over the seeds, by scene and method."""
    groups: dict[str, dict[str, list[Cells]]] = {}
    for member in members:
        scores = groups.setdefault(Path(member["scene"]).name, {}).setdefault(member["variant"], [])
        scores.append(member["scores"].get("welllit", {}))
    return {scene: {name: means(scores) for name, scores in methods.items()} for scene, methods in groups.items()}


def markdown(found: dict[str, dict[str, Cells]]) -> str:
    parts = []
    for scene, methods in found.items():
        rows = [(name, [cells]) for name, cells in methods.items()]
        rows += [(f"paper: {name}", [cells]) for name, cells in TABLE1.get(scene, {}).items()]
        parts.append(f"## {scene}\n\n{table(rows, (*MEASURES, AFTER_GAIN))}")
    return "\n".join(parts)


if __name__ == "__main__":
    command_line.run(main, sys.argv[1:], huge_pages=True)
