"""`python -m experiments.quality.table STUDY...`: results of studies in tables of means and spreads over seeds.

Each argument is a folder that `python -m l2dgs_jax.sweep` has filled, or a file of numbers that `--json FILE` has
written. Each scene has a table, with a row for each combination of settings and a column for each score: the mean and,
with several seeds, half the range over them. Members that diverged are named and left out. If there is only one
combination of settings, there is one table with a row for each scene.
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

from experiments.members import left_out
from l2dgs_jax.study.report import FINISHED

Row = tuple[tuple[str, str], ...]  # names and values of settings
Found = dict[Row, dict[str, dict[str, list[float]]]]  # by settings, scene and name of a score: its values for all seeds
SCORES = {
    "low": ("lowlight", "psnr"),
    "moving": ("lowlight_regions", "dynamic", "psnr"),
    "still": ("lowlight_regions", "static", "psnr"),
    "lit": ("welllit", "overall", "psnr"),
    "gain": ("welllit", "overall", "psnr_gain"),
    "moving gain": ("welllit", "dynamic", "psnr_gain"),
    "SSIM": ("welllit", "overall", "ssim"),
}


@dataclass(frozen=True)
class Table:
    """Compare studies.

    Attributes:
        studies: folders that `sweep` has filled, or files that --json has written.
        json: file to write the numbers to.
        brief: print only low-light PSNR, PSNR after the gain and SSIM, rounded, with all scenes in one table.
    """

    studies: tyro.conf.Positional[tuple[Path, ...]]
    json: Path | None = None
    brief: bool = False


def collect(studies: Sequence[Path]) -> Found:
    """Scores of all studies together; members that diverged are named on standard error and left out."""
    found: Found = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for study in studies:
        if study.is_file():
            for kept in _kept(study):
                found[tuple(kept["settings"].items())] |= kept["scenes"]
            continue
        members = json.loads((study / "results.json").read_text())["members"]
        for missing in left_out(members):
            print(f"{study}: {missing} is left out", file=sys.stderr)
        for member in members:
            varied = {name: value for name, value in member["varied"].items() if name != "seed"}
            row = tuple((name, str(value)) for name, value in varied.items())
            scores = found[row][Path(member["scene"]).name]
            for name, path in SCORES.items() if member["ended"] == FINISHED else ():
                score = _score(member["scores"], path)
                if score is not None:
                    scores[name].append(score)
    return found


def _kept(path: Path) -> list[dict[str, Any]]:
    """The rows of a file; a row can refer to another file beside it.

    It names that file, the index of a row there and, unless it takes all, the scenes that it takes from that row.
    """
    rows = json.loads(path.read_text())
    for row in rows:
        if isinstance(row["scenes"], list):
            name, index, *chosen = row["scenes"]
            scenes = _kept(path.parent / name)[index]["scenes"]
            row["scenes"] = {scene: scenes[scene] for scene in chosen or scenes}
    return rows


def _score(scores: Any, path: Sequence[str]) -> float | None:
    for key in path:
        scores = scores.get(key) if isinstance(scores, dict) else None
    return None if scores is None else round(float(scores), 4)


def markdown(found: Found) -> str:
    """A table for each scene, with a row for each combination of settings; for one combination, one row per scene."""
    scenes = _scenes(found)
    if len(found) == 1:
        ((row, rows),) = found.items()
        return _table(_label(row), rows)
    parts = ({_label(row): rows[scene] for row, rows in found.items() if scene in rows} for scene in scenes)
    return "\n".join(map(_table, scenes, parts))


def brief(found: Found) -> str:
    """One table with a row for each combination of settings and a column for each scene."""
    scenes = _scenes(found)
    lines = [["low, gain / SSIM", *scenes], ["---"] * (len(scenes) + 1)]
    lines += ([_label(row), *(_brief_cell(rows.get(scene)) for scene in scenes)] for row, rows in found.items())
    return _lines(lines)


def _scenes(found: Found) -> list[str]:
    return list(dict.fromkeys(scene for rows in found.values() for scene in rows))


def _brief_cell(scores: dict[str, list[float]] | None) -> str:
    if not scores:
        return ""
    low, gain, ssim = (
        f"{np.mean(scores[name]):.{digits}f}" if name in scores else "–"
        for name, digits in (("low", 1), ("gain", 1), ("SSIM", 2))
    )
    return f"{low}, {gain} / {ssim}"


def _table(corner: str, rows: dict[str, dict[str, list[float]]]) -> str:
    shown = [name for name in SCORES if any(name in scores for scores in rows.values())]
    lines = [[corner, "seeds", *shown], ["---"] * (len(shown) + 2)]
    for label, scores in rows.items():
        seeds = max(map(len, scores.values()), default=0)
        lines.append([label, str(seeds), *(_cell(name, scores.get(name)) for name in shown)])
    return _lines(lines)


def _lines(lines: Sequence[Sequence[str]]) -> str:
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _label(row: Row) -> str:
    return ", ".join(f"{name} {value}".strip() for name, value in row) or "the preset"


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
        options.json.write_text(json.dumps(rows) + "\n")
    sys.stdout.write(brief(found) if options.brief else markdown(found))


if __name__ == "__main__":
    main()
