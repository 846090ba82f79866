"""`python -m experiments.quality.table STUDY...`: what studies found, in one table of means and spreads over seeds.

Each argument is a folder that `python -m l2dgs_jax.sweep` has filled. A row is a combination of settings, a column a
score on one scene: mean and, with several seeds, half the range over them. `--json FILE` keeps the table's numbers.
"""

import json
import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

Row = tuple[tuple[str, str], ...]  # names and values of settings
SCORES = {
    "low": ("lowlight", "psnr"),
    "moving": ("lowlight_regions", "dynamic", "psnr"),
    "still": ("lowlight_regions", "static", "psnr"),
    "gain": ("welllit", "overall", "psnr_gain"),
    "SSIM": ("welllit", "overall", "ssim"),
}


@dataclass(frozen=True)
class Table:
    """Compare studies.

    Attributes:
        studies: folders that `sweep` has filled.
        json: file for the numbers.
    """

    studies: tyro.conf.Positional[tuple[Path, ...]]
    json: Path | None = None


def collect(studies: Sequence[Path]) -> dict[Row, dict[str, dict[str, list[float]]]]:
    """Scores over the seeds, by settings, scene and name."""
    found: dict[Row, dict[str, dict[str, list[float]]]] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for study in studies:
        for member in json.loads((study / "results.json").read_text())["members"]:
            varied = {name: value for name, value in member["varied"].items() if name != "seed"}
            row = tuple((name, str(value)) for name, value in varied.items())
            for name, path in SCORES.items():
                score = _score(member["scores"], path)
                if score is not None:
                    found[row][Path(member["scene"]).name][name].append(score)
    return found


def _score(scores: Any, path: Sequence[str]) -> float | None:
    for key in path:
        scores = scores.get(key) if isinstance(scores, dict) else None
    return None if scores is None else float(scores)


def markdown(found: dict[Row, dict[str, dict[str, list[float]]]]) -> str:
    """One table a scene: a row for each combination of settings."""
    scenes = list(dict.fromkeys(scene for rows in found.values() for scene in rows))
    parts = []
    for scene in scenes:
        shown = [name for name in SCORES if any(name in rows.get(scene, {}) for rows in found.values())]
        lines = [[scene, "seeds", *shown], ["---"] * (len(shown) + 2)]
        for row, rows in found.items():
            if scene in rows:
                seeds = max(map(len, rows[scene].values()))
                lines.append([_label(row), str(seeds), *(_cell(name, rows[scene].get(name)) for name in shown)])
        parts.append("".join(f"| {' | '.join(cells)} |\n" for cells in lines))
    return "\n".join(parts)


def _label(row: Row) -> str:
    return ", ".join(f"{name} {value}" for name, value in row) or "the preset"


def _cell(name: str, scores: list[float] | None) -> str:
    if not scores:
        return ""
    digits = 3 if name == "SSIM" else 2
    spread = f" ± {np.ptp(scores) / 2:.{digits}f}" if len(scores) > 1 else ""
    return f"{np.mean(scores):.{digits}f}{spread}"


def main() -> None:
    """Print the table."""
    options = tyro.cli(Table)
    found = collect(options.studies)
    if options.json is not None:
        rows = [{"settings": dict(row), "scenes": scenes} for row, scenes in found.items()]
        options.json.write_text(json.dumps(rows, indent=1) + "\n")
    sys.stdout.write(markdown(found))


if __name__ == "__main__":
    main()
