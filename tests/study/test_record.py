"""The record of quality: its studies can be read, and its table says what they found."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from l2dgs_jax.study import spec

ROOT = Path(__file__).parents[2]
STUDIES = sorted((ROOT / "experiments" / "quality" / "studies").glob("*.toml"))


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_its_studies_can_be_read(path):
    plans = spec.read(path).plans
    assert {plan.varied["seed"] for plan in plans} == {0, 1, 2}
    assert all(plan.config.downscale == 2 for plan in plans)


def member(scene, seed, inbetweens, psnr):
    scores = {"lowlight": {"psnr": psnr, "ssim": 0.9}, "gaussians": 10}
    return {"scene": f"/scenes/{scene}", "varied": {"seed": seed, **inbetweens}, "ended": "finished", "scores": scores}


def test_its_table_has_means_and_spreads_over_seeds(tmp_path):
    without, found = {"inbetweens": 0.0}, {"first": [], "second": []}
    found["first"] += [member("toys", seed, {}, psnr) for seed, psnr in enumerate((36.0, 36.5, 37.0))]
    found["second"] += [member("toys", seed, without, psnr) for seed, psnr in enumerate((35.0, 35.2))]
    found["second"].append(member("room", 0, without, 30.0))
    for name, members in found.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps({"members": members}))
    command = [sys.executable, "-m", "experiments.quality.table", *(str(tmp_path / name) for name in found)]
    ran = subprocess.run(
        [*command, "--json", str(tmp_path / "table.json")], cwd=ROOT, capture_output=True, text=True, check=True
    )
    toys, room = (part.splitlines() for part in ran.stdout.split("\n\n"))
    assert toys[0] == "| toys | seeds | low |"
    assert toys[2:] == ["| the preset | 3 | 36.50 ± 0.50 |", "| inbetweens 0.0 | 2 | 35.10 ± 0.10 |"]
    assert room[2:] == ["| inbetweens 0.0 | 1 | 30.00 |"]
    kept = json.loads((tmp_path / "table.json").read_text())
    assert kept[1]["scenes"]["toys"]["low"] == [35.0, 35.2]
