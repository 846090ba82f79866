"""`python -m experiments.table3 OUT [--scenes SCENE ...]`: the eleven ablations of the paper's Table 3, and none.

Scores are means over the scenes of those of held-out well-lit views, the paper's in brackets. OUT/table3.md has the
table, OUT/table3.json the same numbers.
"""

import sys
from collections.abc import Sequence
from typing import Any

import tyro

from experiments.published import TABLE3, Cells
from experiments.tables import Options, means, table, trained, write
from l2dgs_jax.runtime import command_line


def main(arguments: Sequence[str]) -> None:
    options = tyro.cli(Options, args=arguments)
    found = collect(trained(options, "table3.toml"))
    write(options, "table3", {"rows": found, "paper": TABLE3}, markdown(found))


def collect(members: Sequence[dict[str, Any]]) -> dict[str, Cells]:
    """Mean scores over scenes and seeds, by variant."""
    names = dict.fromkeys(member["variant"] for member in members)
    return {
        name: means(member["scores"].get("welllit", {}) for member in members if member["variant"] == name)
        for name in names
    }


def markdown(found: dict[str, Cells]) -> str:
    return table([(name, [cells, TABLE3.get(name, {})]) for name, cells in found.items()])


if __name__ == "__main__":
    command_line.run(main, sys.argv[1:], huge_pages=True)
