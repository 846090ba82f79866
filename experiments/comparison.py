"""`python -m experiments.comparison STUDY OUT.html`: the same views by all methods of a study, side by side.

Makes a self-contained page: for every scene the dark input, each variant's well-lit view and the ground truth, with a
slider over time, a curtain between any two of them, an enlarged part of all, depth, and a plot of the trainings. STUDY
is a folder that `sweep`, or one of the scripts for the paper's tables, has filled.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import UInt8

from experiments.members import Member, labels
from experiments.web_page import write_page
from l2dgs_jax.cameras import median_depth
from l2dgs_jax.data.images import encode_jpeg, to_bytes
from l2dgs_jax.data.parsing import read_json, value
from l2dgs_jax.data.stacks import evenly_spread
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs import open_run, read_metrics
from l2dgs_jax.runs.views import views
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import takes_file
from l2dgs_jax.runtime.pages import data_url
from l2dgs_jax.study import report
from l2dgs_jax.types import Camera
from l2dgs_jax.visualize import display

JPEG_QUALITY = 92
CURVE_POINTS = 60  # of the plot of a training
INPUT, TRUTH = "input", "truth"  # names on the page of the pictures that no member rendered


@dataclass(frozen=True)
class Options:
    """Compare the methods of a study on a page.

    Attributes:
        study: folder that `sweep` or a script for the paper's tables has filled.
        output: the page, .html.
        views: number of held-out views of each scene, spread over time.
    """

    study: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    views: int = 8


def main(arguments: Sequence[str]) -> None:
    options = tyro.cli(Options, args=arguments)
    if options.views < 1:
        raise UserError(f"--views {options.views}: expected at least 1")
    if not takes_file(options.output):
        raise UserError(f"{options.output}: cannot be written; expected a file in a writable folder")
    scenes = _members(options.study)
    names = report.scene_names(scenes)
    shown = [_scene(options.study, names[scene], members, options.views) for scene, members in scenes.items()]
    write_page(options.output, Path(__file__).with_suffix(".html"), shown)
    print(f"wrote {options.output}, {options.output.stat().st_size / 2**20:.1f} MiB")


def _members(study: Path) -> dict[str, dict[str, Member]]:
    """The members with the first seed, by scene and by their names on the page."""
    path, what = study / report.JSON, "the results of a study that has ended"
    members = value(path, read_json(path, what), "members", list)
    keys = {"name", "scene", "variant", "varied", "ended"}
    if not members or not all(isinstance(member, dict) and keys <= member.keys() for member in members):
        raise UserError(f"{path}: its members lack some of {', '.join(sorted(keys))}; expected {what}")
    called = labels(members)
    scenes: dict[str, dict[str, Member]] = {}
    for member in members:
        name = called[member["name"]]
        if name in (INPUT, TRUTH):
            raise UserError(f"{path}: a variant is called {name!r}, as other pictures are; expected another name there")
        if member["varied"]["seed"] == members[0]["varied"]["seed"]:
            name += "" if member["ended"] == report.FINISHED else f" ({member['ended']})"
            scenes.setdefault(member["scene"], {})[name] = member
    return scenes


def _scene(study: Path, name: str, members: dict[str, Member], count: int) -> dict[str, Any]:
    """Pictures and depths of one scene by name, each a list over the same instants, and curves of the trainings."""
    pictures: dict[str, list[str]] = {}
    depths: dict[str, list[str]] = {}
    split, chosen, ranges = None, np.zeros(0, int), None
    for label, member in members.items():
        run = open_run(study / member["name"])
        own = run.dataset.test
        if split is None:
            split = own
            in_time = np.argsort(split.cameras.time, kind="stable")
            chosen = in_time[evenly_spread(len(in_time), count)]
            pictures[INPUT] = [_url(to_bytes(split.images[i])) for i in chosen]
        if own.names != split.names:
            raise UserError(
                f"{study / member['name']}: has other held-out views than members before it; expected the same"
            )
        # depth in a unit of the scene itself, because the scale of the world differs (data.normalise)
        unit = median_depth(run.dataset.train.cameras, run.dataset.points)
        rendered = views(run, Camera(*(x[chosen] for x in own.cameras)))
        outputs = [output._replace(depth=output.depth / unit) for output in rendered]
        ranges = ranges or display.ranges(outputs)
        for kind, shown in (("welllit", pictures), ("depth", depths)):
            shown[label] = [_url(display.shown(output, kind, ranges)) for output in outputs]
    assert split is not None
    if split.welllit is not None:
        pictures[TRUTH] = [_url(to_bytes(split.welllit[i])) for i in chosen]
    return {
        "name": name,
        "size": split.images.shape[2:0:-1],
        "times": [float(time) for time in split.cameras.time[chosen]],
        "pictures": pictures,
        "depths": depths,
        "curves": {label: _curve(study / member["name"]) for label, member in members.items()},
    }


def _curve(run: Path) -> list[list[float]]:
    """Pairs of step and low-light PSNR of a run, means over consecutive lines of its metrics."""
    pairs = [(line["step"], line["psnr"]) for line in read_metrics(run)]
    finite = np.array([pair for pair in pairs if np.isfinite(pair).all()]).reshape(-1, 2)
    parts = np.array_split(finite, min(len(finite), CURVE_POINTS)) if len(finite) else []
    return [part.mean(0).tolist() for part in parts]


def _url(picture: UInt8[np.ndarray, "H W 3"]) -> str:
    return data_url(encode_jpeg(picture, JPEG_QUALITY), "picture.jpg")


if __name__ == "__main__":
    command_line.run(main, sys.argv[1:], huge_pages=True)
