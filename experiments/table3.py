"""`python -m experiments.table3 OUT [--scenes SCENE ...]`: the eleven ablations of Table 3, and the whole method.

Scores are those of held-out well-lit views, as means over the scenes; the paper's are in brackets. OUT/table3.md has
the table, OUT/table3.json the same numbers.
"""

import sys
from collections.abc import Sequence

import tyro

from experiments.published import TABLE3
from experiments.tables import (
    WITH_GAIN,
    Cells,
    Options,
    collect,
    over_scenes,
    scenes_by_region,
    table,
    trained,
    welllit,
    write,
)
from l2dgs_jax.runtime import command_line


def main(arguments: Sequence[str]) -> None:
    options = tyro.cli(Options, args=arguments)
    members = trained(options, "table3.toml")
    found = collect(members, welllit)
    rows = over_scenes(found)
    write(options, "table3", members, {"rows": rows, "paper": TABLE3}, markdown(rows) + scenes_by_region(found))


def markdown(found: dict[str, Cells]) -> str:
    return table([(name, [cells, TABLE3.get(name, {})]) for name, cells in found.items()], WITH_GAIN)


if __name__ == "__main__":
    command_line.run(main, sys.argv[1:], huge_pages=True)
