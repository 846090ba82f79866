"""`python -m experiments.lowlight OUT [--scenes SCENE ...]`: how well the low-light input is estimated (section 5).

Scores compare the estimates of held-out low-light views with these views, by scene and variant; means over the scenes
stand beside the paper's. A variant that learns from brightened frames makes no such estimate. OUT/lowlight.md has the
table, OUT/lowlight.json the scores of each scene and seed.
"""

import sys
from collections.abc import Sequence
from typing import Any

import tyro

from experiments.published import LOWLIGHT
from experiments.tables import Cells, Options, collect, over_scenes, scenes_by_region, table, trained, write
from l2dgs_jax.runtime import command_line


def main(arguments: Sequence[str]) -> None:
    options = tyro.cli(Options, args=arguments)
    members = trained(options, "lowlight.toml")
    found = collect(members, lowlight)
    write(options, "lowlight", members, {"scenes": found, "paper": LOWLIGHT}, markdown(found))


def lowlight(scores: dict[str, Any]) -> Cells:
    """The scores of the low-light estimate, by region; empty if there is no such estimate."""
    return scores.get("lowlight_regions", {}) | {"overall": scores.get("lowlight", {})}


def markdown(found: dict[str, dict[str, Cells]]) -> str:
    parts = [*found.items(), ("mean", over_scenes(found))]
    rows = [(f"{part}: {label}", [cells]) for part, methods in parts for label, cells in methods.items()]
    return table([*rows, ("paper: L2DGS", [LOWLIGHT])]) + scenes_by_region(found)


if __name__ == "__main__":
    command_line.run(main, sys.argv[1:], huge_pages=True)
