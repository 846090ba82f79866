"""The results of a study: a table of all members as JSON and as Markdown, and plots."""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from l2dgs_jax import runs
from l2dgs_jax.runtime.files import replacing, write_json

JSON, MARKDOWN, PLOTS = "results.json", "results.md", "results.png"
RESULT_FILE = "result.json"  # in the folder of a member
FINISHED = "finished"  # "ended" of a member that did not diverge
OWN_GAIN = " (own gain)"  # marks a score that `own_gain` tells from the others

_SCORES = {
    "low-light PSNR": ("lowlight", "psnr"),
    "low-light SSIM": ("lowlight", "ssim"),
    "well-lit PSNR": ("welllit", "overall", "psnr"),
    "after one gain": ("welllit", "overall", "psnr_gain"),
    "well-lit SSIM": ("welllit", "overall", "ssim"),
}


def write(folder: Path, names: Sequence[str]) -> list[str]:
    """Collect the members' results in the study's folder; returns the names of the files written.

    Raises:
        UserError: the folder cannot be written to.
    """
    members = [{"name": name, **json.loads((folder / name / RESULT_FILE).read_text())} for name in names]
    write_json(folder / JSON, {"members": members})
    with replacing(folder / MARKDOWN) as temporary:
        temporary.write_text(markdown(members))
    try:
        import matplotlib  # noqa: F401
    except ModuleNotFoundError:
        return [JSON, MARKDOWN]
    with replacing(folder / PLOTS) as temporary:
        _plot(temporary, members, folder)
    return [JSON, MARKDOWN, PLOTS]


def scene_names(scenes: Iterable[str]) -> dict[str, str]:
    """Short names of scenes, by their paths: of the ends of these as much as tells them apart."""
    parts = {scene: Path(scene).parts for scene in scenes}

    def shared(scene: str, length: int) -> bool:
        return sum(other[-length:] == parts[scene][-length:] for other in parts.values()) > 1

    lengths = {s: next((n for n in range(1, len(own)) if not shared(s, n)), len(own)) for s, own in parts.items()}
    return {scene: "/".join(parts[scene][-length:]) for scene, length in lengths.items()}


def markdown(members: Sequence[dict[str, Any]]) -> str:
    """A table with a row for each member: what was varied, how it ended, and the scores that it has.

    Low-light scores after gains of their own are marked, because they are higher than those without.
    """
    names = scene_names(member["scene"] for member in members)
    variant = ["variant"] if any(member["variant"] for member in members) else []
    varied = list(dict.fromkeys(name for member in members for name in member["varied"]))
    shown = [name for name, path in _SCORES.items() if any(_score(member, path) is not None for member in members)]
    header = ["scene", *variant, *varied, "ended", "Gaussians", *shown]
    lines = [header, ["---"] * len(header)]
    for member in members:
        cells = [names[member["scene"]], *(member[key] for key in variant)]
        cells += [*(_text(member["varied"].get(name)) for name in varied)]
        cells += [member["ended"], str(member["scores"]["gaussians"])]
        lines.append(cells + [_shown(member, _SCORES[name]) for name in shown])
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _score(member: dict[str, Any], path: Sequence[str]) -> float | None:
    found: Any = member["scores"]
    for key in path:
        found = found.get(key) if isinstance(found, dict) else None
    return None if found is None else float(found)


def own_gain(member: dict[str, Any], path: Sequence[str]) -> bool:
    """Whether this is a low-light score of estimates that were each compared after the gain that suits it best."""
    return path[0].startswith("lowlight") and member["scores"].get("lowlight_gain") == "own"


def _shown(member: dict[str, Any], path: Sequence[str]) -> str:
    score = _score(member, path)
    return "" if score is None else f"{score:.3f}" + OWN_GAIN * own_gain(member, path)


def _text(value: Any) -> str:
    return "" if value is None else str(value)


def _plot(path: Path, members: Sequence[dict[str, Any]], folder: Path) -> None:
    """Plot the members' low-light PSNR during training, and their final PSNRs side by side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, max(4, 0.3 * len(members))), layout="constrained")
    over_time, ends = figure.subplots(1, 2, width_ratios=(3, 2))
    for member in members:
        lines = runs.read_metrics(folder / member["name"])
        over_time.plot([line["step"] for line in lines], [line["psnr"] for line in lines], label=member["name"])
    over_time.set(xlabel="step", ylabel="low-light PSNR of the step's views, dB")
    over_time.legend(fontsize=6)
    shown = [name for name, path in _SCORES.items() if path[-1].startswith("psnr")]
    for offset, name in enumerate(shown):
        found = [_score(member, _SCORES[name]) for member in members]
        values = [score if score is not None and math.isfinite(score) else 0 for score in found]
        places = [index + 0.8 * offset / len(shown) for index in range(len(members))]
        bars = ends.barh(places, values, height=0.8 / len(shown), label=name)
        marks = [OWN_GAIN * own_gain(member, _SCORES[name]) for member in members]
        ends.bar_label(bars, marks, label_type="center", color="white", fontsize=6)
    ends.set(xlabel="held-out views, dB", yticks=range(len(members)))
    ends.set_yticklabels([member["name"] for member in members], fontsize=6)
    ends.invert_yaxis()
    ends.legend(fontsize=6, loc="lower center", bbox_to_anchor=(0.5, 1), ncols=len(shown))
    figure.savefig(path, dpi=120, format="png")
