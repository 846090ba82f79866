"""What the scripts for the paper's tables share: running or resuming a study, and its scores by region."""

import dataclasses
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from experiments import markdown
from experiments.members import Member, labels, left_out
from experiments.published import MEASURES, REGIONS
from l2dgs_jax.config import overrides
from l2dgs_jax.errors import UserError
from l2dgs_jax.metrics import Convention, Lpips, Network
from l2dgs_jax.runs import open_run
from l2dgs_jax.runs.lpips_weights import find_lpips
from l2dgs_jax.runs.scores import evaluate
from l2dgs_jax.runtime import devices
from l2dgs_jax.runtime.files import is_taken, replacing, write_json
from l2dgs_jax.study import report, running
from l2dgs_jax.study.spec import Spec, read

STUDIES = Path(__file__).parent / "studies"
# Scores by region and measure: one, or one for each seed, None where it has none; a list can end before the last seed.
Cells = Mapping[str, Mapping[str, float | Sequence[float | None]]]

TITLES = {
    "psnr": "PSNR",
    "ssim": "SSIM",
    "lpips_alex": "LPIPS",
    "psnr_gain": "PSNR after gain",
    "area": "share of pixels",
}
DECIMALS = {"psnr": 1, "ssim": 2, "lpips_alex": 3, "psnr_gain": 1}
WITH_GAIN = (*MEASURES, "psnr_gain")  # PSNR after one gain shows whether an image is only too dark, or wrong
CONVENTION: Convention = "paper"  # for scoring regions with LPIPS; for PSNR and SSIM it is the same as the default
# Settings of a smoke run; QUICK_STEPS is the number of steps of each stage that a member has.
QUICK_STEPS = 3
QUICK = {"model.plane_size": 8, "model.hidden": 8, "model.tracks": False, "model.surfaces": False}
QUICK |= {"inbetweens": 0.0, "density.stop": 0}


@dataclass(frozen=True)
class Options:
    """Train what a table compares, and show it beside the paper's figures.

    Attributes:
        output: folder for the study and the table; the same command continues where it was interrupted.
        study: TOML file to use instead of the one in experiments/studies; the names of its variants are the rows.
        scenes: folders of scenes to use instead of the study's.
        lpips_alex: files with the weights of LPIPS, as for `evaluate`; without them its columns may stay empty.
        quick: only a few steps on the first scene, to check that everything works; the scores mean nothing.
    """

    output: tyro.conf.Positional[Path]
    study: Path | None = None
    scenes: tuple[str, ...] = ()
    lpips_alex: tuple[Path, ...] = ()
    quick: bool = False


def trained(options: Options, study: str) -> list[Member]:
    """Run or resume a study; returns the results of all its members, as in `results.json`.

    Raises:
        UserError: as `run_study`, weights of LPIPS cannot be read, or the folder holds something else.
    """
    begun = (options.output / running.PLANS_FILE).exists()
    if is_taken(options.output) and not begun:
        raise UserError(f"{options.output}: already holds files; expected a new folder, or that of the same command")
    devices.one_per_core()
    lpips = find_lpips({"alex": options.lpips_alex})
    scenes = [scene if scene == "demo" else str(Path(scene).absolute()) for scene in options.scenes]
    spec = read(options.study or STUDIES / study, scenes)
    spec = _quick(spec) if options.quick else spec
    running.run_study(spec, options.output, resume=begun)
    if lpips:
        _score_again(options.output, lpips)
    return _members(options.output)


def _members(study: Path) -> list[Member]:
    return json.loads((study / report.JSON).read_text())["members"]


def _score_again(study: Path, lpips: dict[Network, Lpips]) -> None:
    """Score finished members with LPIPS too, unless that was done before."""
    members = _members(study)
    for member in members:
        if member["ended"] == report.FINISHED and member["scores"]["region_convention"] != CONVENTION:
            scores = evaluate(open_run(study / member["name"]), lpips=lpips, convention=CONVENTION)
            path = study / member["name"] / report.RESULT_FILE
            write_json(path, json.loads(path.read_text()) | {"scores": scores})
    report.write(study, [member["name"] for member in members])


def _quick(spec: Spec) -> Spec:
    first = spec.plans[0]
    plans = []
    for plan in spec.plans:
        if (plan.scene, plan.config.seed) == (first.scene, first.config.seed):
            steps = {
                name: min(overrides.read(plan.config, name), QUICK_STEPS) for name in ("coarse_steps", "fine_steps")
            }
            plans.append(dataclasses.replace(plan, config=overrides.replace(plan.config, QUICK | steps)))
    return Spec(tuple(plans), spec.one_program)


def collect(members: Sequence[Member], cells: Callable[[dict[str, Any]], Cells]) -> dict[str, dict[str, Cells]]:
    """Scores of the seeds by scene and label, in the order of the seeds; those that diverged have none.

    Args:
        members: of a study.
        cells: selects the scores for a table from all scores of a member.
    """
    names, scenes = labels(members), report.scene_names(member["scene"] for member in members)
    seeds = sorted({member["varied"]["seed"] for member in members})
    groups: dict[str, dict[str, dict[int, Cells]]] = {}
    for member in members:
        group = groups.setdefault(scenes[member["scene"]], {}).setdefault(names[member["name"]], {})
        if member["ended"] == report.FINISHED:
            group[member["varied"]["seed"]] = cells(member["scores"])
    return {
        scene: {label: _listed(group.get(seed, {}) for seed in seeds) for label, group in rows.items()}
        for scene, rows in groups.items()
    }


def over_scenes(found: dict[str, dict[str, Cells]]) -> dict[str, Cells]:
    """Means over the scenes for each seed that has them all, by label; none without such a seed.

    Otherwise a row that lacks a hard scene, because it diverged there, would look better than the others.
    """
    rows = dict.fromkeys(label for scores in found.values() for label in scores)
    scored: dict[tuple[str, str], set[str]] = defaultdict(set)
    for scene, scores in found.items():
        for cells in scores.values():
            for region, measures in cells.items():
                for measure in measures:
                    scored[region, measure].add(scene)
    means: dict[str, dict[str, dict[str, list[float]]]] = {label: defaultdict(dict) for label in rows}
    for (region, measure), scenes in scored.items():
        for label in rows:
            values: list[Any] = [found[scene].get(label, {}).get(region, {}).get(measure, ()) for scene in scenes]
            seeds = [float(np.mean(scores)) for scores in zip(*values, strict=False) if None not in scores]
            if seeds:
                means[label][region][measure] = seeds
    return means


def scenes_by_region(found: dict[str, dict[str, Cells]]) -> str:
    """A line on how many scenes the means of `over_scenes` are over: those without masks only count for "overall"."""
    scored = [{region for cells in rows.values() for region in cells} for rows in found.values()]
    counts = {region: sum(region in regions for regions in scored) for region in REGIONS}
    return f"\nScenes in the means: {', '.join(f'{region} {count}' for region, count in counts.items())}.\n"


def welllit(scores: dict[str, Any]) -> Cells:
    """The scores of the well-lit views, by region; empty without ground truth."""
    return scores.get("welllit", {})


def _listed(seeds: Iterable[Mapping[str, Mapping[str, Any]]]) -> Cells:
    """The scores of all seeds, for each region and measure that any of them has."""
    found: dict[str, dict[str, list[float | None]]] = defaultdict(lambda: defaultdict(list))
    for index, cells in enumerate(seeds):
        for region, measures in cells.items():
            for measure, value in measures.items():
                if value is not None:
                    scores = found[region][measure]
                    scores += [None] * (index - len(scores)) + [float(value)]  # "Infinity" is a string in JSON
    return found


def table(rows: Sequence[tuple[str, Sequence[Cells]]], measures: Sequence[str] = MEASURES) -> str:
    """Markdown with a column for each region and measure, and for the region's share of the pixels.

    Of several seeds, a cell has the mean and half the range. All figures of a cell but the first are in brackets.
    """
    columns = [
        (region, measure)
        for region in REGIONS
        for measure in (*measures, "area")
        if any(measure in cells.get(region, {}) for _, parts in rows for cells in parts)
    ]
    lines = [["", *(f"{region} {TITLES[measure]}" for region, measure in columns)]]
    lines.append(["---"] * len(lines[0]))
    for name, parts in rows:
        shown = []
        for region, measure in columns:
            own, *others = (_text(cells.get(region, {}).get(measure), measure) for cells in parts)
            shown.append(own + "".join(f" ({other})" for other in others if measure in MEASURES))
        lines.append([name, *shown])
    return markdown.table_rows(lines)


def _text(scores: float | Sequence[float | None] | None, measure: str) -> str:
    if scores is None:
        return "" if measure == "area" else "–"
    if not isinstance(scores, Sequence):
        return markdown.mean_and_spread(scores, min(DECIMALS[measure], 2))  # published with two decimals
    known = [score for score in scores if score is not None]
    return f"{np.mean(known):.0%}" if measure == "area" else markdown.mean_and_spread(known, DECIMALS[measure])


def write(options: Options, name: str, members: Sequence[Member], content: Any, text: str) -> None:
    """Write a table's numbers to NAME.json and the table with explanations to NAME.md, and print the latter."""
    conventions = {member["scores"]["region_convention"] for member in members if member["ended"] == report.FINISHED}
    if conventions:
        shown = " or ".join(sorted(conventions))
        text += f"\nOur regions are scored by the convention {shown}, see docs/metrics.md.\n"
    missing = left_out(members)
    if missing:
        text += f"\nLeft out of all means: {', '.join(missing)}.\n"
    seeds = {member["varied"]["seed"] for member in members}
    if len(seeds) > 1:
        text += f"\nMeans over {len(seeds)} seeds, ± half of the range.\n"
    if options.quick:
        text = f"A smoke run of {QUICK_STEPS} steps a stage: its scores mean nothing.\n\n{text}"
    write_json(options.output / f"{name}.json", {"quick": options.quick, "left_out": missing} | content)
    with replacing(options.output / f"{name}.md") as temporary:
        temporary.write_text(text)
    print(text)
