"""`python -m experiments.table1 OUT [--scenes SCENE ...]`: methods by scenes and regions, as in the paper's Table 1.

Scores are those of held-out well-lit views. OUT/table1.md has a table for each scene, with the paper's figures if it is
one of its scenes; OUT/table1.json has the same numbers.
"""

import sys
from collections.abc import Sequence

import tyro

from experiments.published import TABLE1
from experiments.tables import WITH_GAIN, Cells, Options, collect, table, trained, welllit, write
from l2dgs_jax.runtime import command_line


def main(arguments: Sequence[str]) -> None:
    options = tyro.cli(Options, args=arguments)
    members = trained(options, "table1.toml")
    found = collect(members, welllit)
    write(options, "table1", members, {"scenes": found, "paper": TABLE1}, markdown(found))


def markdown(found: dict[str, dict[str, Cells]]) -> str:
    parts = []
    for scene, methods in found.items():
        rows = [(name, [cells]) for name, cells in methods.items()]
        rows += [(f"paper: {name}", [cells]) for name, cells in TABLE1.get(scene, {}).items()]
        parts.append(f"## {scene}\n\n{table(rows, WITH_GAIN)}")
    return "\n".join(parts)


if __name__ == "__main__":
    command_line.run(main, sys.argv[1:], huge_pages=True)
