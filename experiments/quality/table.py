"""`python -m experiments.quality.table STUDY...`: results of studies in tables of means and spreads over seeds.

Each argument is a folder that `python -m l2dgs_jax.sweep` has filled, or a file of numbers that `--json FILE` has
written. Each scene has a table, with a row for each variant and combination of the settings that a study varies, and a
column for each score: the mean and, with several seeds, half the range over them. Members that diverged are named and
left out. If there is only one such combination, there is one table with a row for each scene.
"""

import dataclasses
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments.markdown import mean_and_spread, table_rows
from experiments.members import Member, left_out
from l2dgs_jax.config import Config, overrides
from l2dgs_jax.data.parsing import read_json
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import write_json
from l2dgs_jax.study import report, running

Row = tuple[tuple[str, str], ...]  # names and values of settings; the name of a variant is ""
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
    """Scores of all studies together; members that diverged are named on standard error and left out.

    Raises:
        UserError: a study cannot be read, or two have scores of the same row on the same scene, or of the same row with
            different settings. A file has no settings to compare.
    """
    found: Found = {}
    trained: dict[Row, tuple[Path, Config]] = {}  # the first folder with the row, and its settings
    for study in studies:
        if study.is_file():
            new = _kept(study)
        else:
            members = read_json(study / report.JSON, "the results of a study")["members"]
            for row, config in _settings(study, members).items():
                _check_equal(row, (study, config), trained.setdefault(row, (study, config)))
            new = _trained(study, members)
        for row, scenes in new.items():
            rows = found.setdefault(row, {})
            for scene in scenes.keys() & rows.keys():
                raise UserError(
                    f"{study}: has scores of {_label(row)} on {scene}, as another of these studies; expected each once"
                )
            rows |= scenes
    return found


def _settings(study: Path, members: Sequence[Member]) -> dict[Row, Config]:
    """The settings of each row in a folder that `sweep` has filled, all with the same seed."""
    path = study / running.PLANS_FILE
    try:
        configs = {plan["name"]: overrides.from_dict(plan["settings"]) for plan in json.loads(path.read_text())}
        return {_row(member): dataclasses.replace(configs[member["name"]], seed=0) for member in members}
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path}: cannot be read ({error!r}); expected the members' settings, as sweep writes"
        ) from None


def _check_equal(row: Row, one: tuple[Path, Config], other: tuple[Path, Config]) -> None:
    for name, values in overrides.differences([one[1], other[1]]).items():
        raise UserError(
            f"{one[0]}: {name} is {values[0]} for {_label(row)}, but {values[1]} in {other[0]}; "
            "expected studies with the same settings, or with variants of other names"
        )


def _row(member: Member) -> Row:
    variant = (("", member["variant"]),) if member["variant"] else ()
    return (*variant, *((name, str(value)) for name, value in member["varied"].items() if name != "seed"))


def _trained(study: Path, members: Sequence[Member]) -> Found:
    """The scores in a folder that `sweep` has filled."""
    for missing in left_out(members):
        print(f"{study}: {missing} is left out", file=sys.stderr)
    names = report.scene_names(member["scene"] for member in members)
    found: Found = {}
    for member in members:
        scores = found.setdefault(_row(member), {}).setdefault(names[member["scene"]], {})
        for name, path in SCORES.items() if member["ended"] == report.FINISHED else ():
            score = _score(member["scores"], path)
            if score is not None:
                scores.setdefault(name + report.OWN_GAIN * report.own_gain(member, path), []).append(score)
    return found


def _kept(path: Path) -> Found:
    """The scores in a file; a row can refer to another file beside it.

    It names that file, the index of a row there and, unless it takes all, the scenes that it takes from that row.

    Raises:
        UserError: the file is not of this kind.
    """
    found: Found = {}
    try:
        for row in json.loads(path.read_text()):
            scenes = row["scenes"]
            if isinstance(scenes, list):
                name, index, *chosen = scenes
                referred = [*_kept(path.parent / name).values()][index]
                scenes = {scene: referred[scene] for scene in chosen or referred}
            found[tuple(row["settings"].items())] = scenes
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: cannot be read ({error!r}); expected numbers that --json has written") from None
    return found


def _score(scores: Any, path: Sequence[str]) -> float | None:
    for key in path:
        scores = scores.get(key) if isinstance(scores, dict) else None
    return None if scores is None else round(float(scores), 4)  # "Infinity" is a string in JSON


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
    return table_rows(lines)


def _scenes(found: Found) -> list[str]:
    return list(dict.fromkeys(scene for rows in found.values() for scene in rows))


def _brief_cell(scores: dict[str, list[float]] | None) -> str:
    if not scores:
        return ""
    low, own, gain, ssim = (
        f"{np.mean(scores[name]):.{digits}f}" if name in scores else "–"
        for name, digits in (("low", 1), ("low" + report.OWN_GAIN, 1), ("gain", 1), ("SSIM", 2))
    )
    return f"{low if own == '–' else own + report.OWN_GAIN}, {gain} / {ssim}"


def _table(corner: str, rows: dict[str, dict[str, list[float]]]) -> str:
    names = [name + ending for name in SCORES for ending in ("", report.OWN_GAIN)]
    shown = [name for name in names if any(name in scores for scores in rows.values())]
    lines = [[corner, "seeds", *shown], ["---"] * (len(shown) + 2)]
    for label, scores in rows.items():
        seeds = max(map(len, scores.values()), default=0)
        lines.append([label, str(seeds), *(_cell(name, scores.get(name)) for name in shown)])
    return table_rows(lines)


def _label(row: Row) -> str:
    return ", ".join(f"{name} {value}".strip() for name, value in row) or "the preset"


def _cell(name: str, scores: list[float] | None) -> str:
    if not scores:
        return ""
    return mean_and_spread(scores, 3 if name == "SSIM" else 2)


def main(arguments: Sequence[str]) -> None:
    """Print the table."""
    options = tyro.cli(Table, args=arguments)
    found = collect(options.studies)
    if options.json is not None:
        write_json(options.json, [{"settings": dict(row), "scenes": scenes} for row, scenes in found.items()])
    sys.stdout.write(brief(found) if options.brief else markdown(found))


if __name__ == "__main__":
    command_line.run(main)
