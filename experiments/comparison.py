"""`python -m experiments.comparison STUDY OUT.html`: what the methods of a study made of the same views, side by side.

A page that holds everything: for every scene the dark input, each variant's well-lit view and the truth, with a slider
over time, a curtain between any two of them, and an enlarged part of all. STUDY is a folder that `sweep`, or one
of the scripts for the paper's tables, has filled.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import UInt8

from experiments.web_page import write_page
from l2dgs_jax.cameras import select_camera
from l2dgs_jax.data.images import encode_jpeg, to_bytes
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs import open_run
from l2dgs_jax.runs.views import views
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.pages import data_url
from l2dgs_jax.study import report

QUALITY = 92  # of JPEG


@dataclass(frozen=True)
class Options:
    """Compare the methods of a study on a page.

    Attributes:
        study: folder that `sweep` or a table's script has filled.
        output: the page, .html.
        views: held-out views of each scene, spread over time.
    """

    study: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    views: int = 8


def main(arguments: Sequence[str]) -> None:
    options = tyro.cli(Options, args=arguments)
    try:
        members = json.loads((options.study / report.JSON).read_text())["members"]
    except OSError:
        raise UserError(f"{options.study}: holds no {report.JSON}; expected a study that has ended") from None
    scenes: dict[str, list[dict[str, Any]]] = {}
    for member in members:
        if member["varied"]["seed"] == members[0]["varied"]["seed"]:
            scenes.setdefault(member["scene"], []).append(member)
    shown = [_scene(options.study, scene, runs, options.views) for scene, runs in scenes.items()]
    write_page(options.output, Path(__file__).with_suffix(".html"), shown)
    print(f"wrote {options.output}, {options.output.stat().st_size / 2**20:.1f} MiB")


def _scene(study: Path, scene: str, members: Sequence[dict[str, Any]], count: int) -> dict[str, Any]:
    """Pictures of one scene by name, each a list over the same instants."""
    pictures: dict[str, list[str]] = {}
    split, chosen = None, np.zeros(0, int)
    for member in members:
        run = open_run(study / member["name"])
        if split is None:
            split = run.dataset.test
            in_time = np.argsort(split.cameras.time, kind="stable")
            chosen = in_time[np.unique(np.linspace(0, len(in_time) - 1, count).round().astype(int))]
            pictures["input"] = [_url(to_bytes(split.images[i])) for i in chosen]
        cameras = select_camera(split.cameras, chosen)
        name = member["variant"] or member["name"]
        pictures[name] = [_url(to_bytes(output.images.welllit)) for output in views(run, cameras)]
    assert split is not None
    if split.welllit is not None:
        pictures["truth"] = [_url(to_bytes(split.welllit[i])) for i in chosen]
    times = [float(time) for time in split.cameras.time[chosen]]
    size = split.images.shape[2:0:-1]
    return {"name": Path(scene).name, "size": size, "times": times, "pictures": pictures}


def _url(picture: UInt8[np.ndarray, "H W 3"]) -> str:
    return data_url(encode_jpeg(picture, QUALITY), "picture.jpg")


if __name__ == "__main__":
    command_line.run(main, sys.argv[1:], huge_pages=True)
