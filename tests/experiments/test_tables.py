"""The paper's tables: their studies can be read, their figures are the paper's, and results land in the right cells."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import finished_run
import networks
import numpy as np
import pytest
from scenes import write_nerfies

from experiments import lowlight, published, table1, table3, tables
from experiments.members import labels
from l2dgs_jax import metrics
from l2dgs_jax.config import PRESETS, overrides
from l2dgs_jax.errors import UserError
from l2dgs_jax.metrics.lpips import SMALLEST_SIDE
from l2dgs_jax.study import report, running, spec

ROOT = Path(__file__).parents[2]
BASE = PRESETS["paper"]


@pytest.mark.parametrize("path", sorted(tables.STUDIES.glob("*.toml")), ids=lambda path: path.stem)
def test_studies_of_the_tables_can_be_read(path):
    variants = {plan.variant for plan in spec.read(path).plans}
    plans = spec.read(path, ["/elsewhere"]).plans
    assert {plan.scene for plan in plans} == {"/elsewhere"}
    assert {plan.variant for plan in plans} == variants


def test_methods_of_table_1_take_equally_many_steps():
    configs = {plan.variant: plan.config for plan in spec.read(tables.STUDIES / "table1.toml", ["/a"]).plans}
    assert len({config.steps for config in configs.values()}) == 1
    assert len({config.density for config in configs.values()}) == 1
    assert {config.enhance for name, config in configs.items() if name.endswith("_4DGS")} == {
        "none",
        "gamma",
        "clahe",
        "zero-dce",
    }
    assert configs["curve_4DGS"].model.decomposition == "curve"


def test_every_row_of_table_3_differs_from_the_whole_in_one_respect():
    plans = {plan.variant: plan.config for plan in spec.read(tables.STUDIES / "table3.toml", ["/a"]).plans}
    assert list(plans) == list(published.TABLE3)
    changed = {name: set(overrides.differences([plans["whole"], config])) for name, config in plans.items()}
    assert changed.pop("whole") == set()
    assert changed.pop("maximise_r_instead") == {"loss.amplification", "loss.reflectance_amplification"}
    assert all(len(names) == 1 for names in changed.values())
    assert len({*map(frozenset, changed.values())}) == len(changed) - 1, "B1 and B2 share a setting"


@pytest.mark.parametrize("rows", [*published.TABLE1.values(), published.TABLE3])
def test_overall_figures_of_the_paper_lie_between_those_of_its_regions(rows):
    """By SSIM; rows with a figure in the wrong column would mostly fail."""
    sides = []
    for cells in rows.values():
        dynamic, static, overall = (cells[region]["ssim"] for region in published.REGIONS)
        sides.append(min(dynamic, static) - 0.01 <= overall <= max(dynamic, static) + 0.01)
    assert all(sides)


def member(scene, variant, seed, psnr, ended="finished", **varied):
    regions = {region: {"psnr": psnr + k, "ssim": 0.5} for k, region in enumerate(published.REGIONS)}
    lowlight = {"lowlight": regions["overall"], "lowlight_regions": regions | {"covisible": {}}}
    scores = {"region_convention": "nsff", "gaussians": 7, "welllit": regions, **lowlight}
    name = "-".join(map(str, (scene, variant, seed, *varied.values())))
    found = {"name": name, "scene": f"/data/{scene}", "variant": variant, "varied": {"seed": seed, **varied}}
    return found | {"ended": ended, "scores": scores}


MEMBERS = [
    member(scene, variant, seed, 10 * first + second + seed)
    for first, scene in enumerate(("mochi", "mine"))
    for second, variant in enumerate(("L2DGS", "without_ssim"))
    for seed in (0, 2)
]


def rows_of(text):
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    return {name: cells for name, *cells in lines}


def test_table_1_has_each_scene_beside_the_figures_of_the_paper():
    mochi, mine = table1.markdown(tables.collect(MEMBERS, tables.welllit)).split("## ")[1:]
    rows = rows_of(mochi.partition("\n\n")[2])
    flat = "0.50 ± 0.00"
    assert rows["L2DGS"] == ["1.0 ± 1.0", flat, "–", "2.0 ± 1.0", flat, "–", "3.0 ± 1.0", flat, "–"]
    assert rows["paper: L2DGS"] == ["21.0", "0.78", "0.07", "16.1", "0.77", "0.09", "17.6", "0.77", "0.16"]
    assert "paper" not in mine
    assert rows_of(mine.partition("\n\n")[2])["without_ssim"] == [
        "12.0 ± 1.0",
        flat,
        "13.0 ± 1.0",
        flat,
        "14.0 ± 1.0",
        flat,
    ]


def test_table_3_is_a_mean_over_scenes():
    rows = rows_of(table3.markdown(tables.over_scenes(tables.collect(MEMBERS, tables.welllit))))
    assert rows["without_ssim"][:3] == ["7.0 ± 1.0 (14.1)", "0.50 ± 0.00 (0.41)", "– (0.20)"]


def test_a_row_that_lacks_a_scene_of_others_has_no_mean():
    """Having diverged on the hard scene, it would look better than what finished there."""
    lost = [one for one in MEMBERS if one["name"].startswith("mochi-L2DGS")]
    ended = [one | {"ended": "diverged at step 7"} if one in lost else one for one in MEMBERS]
    means = tables.over_scenes(tables.collect(ended, tables.welllit))
    assert means["L2DGS"] == {}
    assert means["without_ssim"]["dynamic"]["psnr"] == [6.0, 8.0]


@pytest.mark.parametrize("missing", ["left out", "diverged at step 7"])
def test_means_over_scenes_are_over_seeds_that_all_scenes_have(missing):
    scores = {("mochi", 1): 10.0, ("mochi", 2): 20.0, ("mine", 0): 0.0, ("mine", 1): 10.0}
    members = [member(scene, "a", seed, psnr) for (scene, seed), psnr in scores.items()]
    if missing != "left out":
        members += [member(scene, "a", seed, 99.0, ended=missing) for scene, seed in (("mochi", 0), ("mine", 2))]
    found = tables.collect(members, tables.welllit)
    assert found["mochi"]["a"]["dynamic"]["psnr"] == [None, 10.0, 20.0]
    assert found["mine"]["a"]["dynamic"]["psnr"] == [0.0, 10.0]
    assert tables.over_scenes(found)["a"]["dynamic"]["psnr"] == [10.0]
    assert rows_of(lowlight.markdown(found))["mochi: a"][0] == "15.0 ± 5.0"
    apart = [one for one in members if one["varied"]["seed"] != 1]
    assert tables.over_scenes(tables.collect(apart, tables.welllit)) == {"a": {}}


def test_below_the_means_stands_how_many_scenes_have_each_region():
    without_masks = member("street", "L2DGS", 0, 5.0)
    without_masks["scores"]["welllit"] = {"overall": {"psnr": 5.0}}
    diverged = member("dark", "L2DGS", 0, 5.0, ended="diverged at step 7")
    found = tables.collect([*MEMBERS, without_masks, diverged], tables.welllit)
    assert tables.scenes_by_region(found) == "\nScenes in the means: dynamic 2, static 2, overall 3.\n"


def test_scenes_of_one_name_are_kept_apart():
    members = [member("a/toys", "x", 0, 10.0), member("b/toys", "x", 0, 30.0)]
    found = tables.collect(members, tables.welllit)
    assert {scene: rows["x"]["dynamic"]["psnr"] for scene, rows in found.items()} == {
        "a/toys": [10.0],
        "b/toys": [30.0],
    }


def test_the_share_of_pixels_stands_beside_the_scores_of_a_region():
    cells = {"dynamic": {"psnr": [20.0], "area": [0.25]}, "overall": {"psnr": [21.0], "area": [1.0]}}
    text = tables.table([("ours", [cells]), ("paper: ours", [{"dynamic": {"psnr": 19.0}}])])
    assert list(rows_of(text).values()) == [
        ["dynamic PSNR", "dynamic share of pixels", "overall PSNR", "overall share of pixels"],
        ["---"] * 4,
        ["20.0", "25%", "21.0", "100%"],
        ["19.0", "", "–", ""],
    ]


def test_lpips_has_a_third_decimal_but_for_published_figures():
    rows = [("ours", [{"dynamic": {"lpips_alex": [0.0314]}}]), ("paper: ours", [{"dynamic": {"lpips_alex": 0.03}}])]
    assert list(rows_of(tables.table(rows)).values())[2:] == [["0.031"], ["0.03"]]


def test_low_light_ends_in_a_mean():
    rows = rows_of(lowlight.markdown(tables.collect(MEMBERS, lowlight.lowlight)))
    flat = "0.50 ± 0.00"
    assert rows["mochi: L2DGS"] == ["1.0 ± 1.0", flat, "2.0 ± 1.0", flat, "3.0 ± 1.0", flat]
    assert (rows["mean: L2DGS"][-2:], rows["mean: without_ssim"][-2:]) == (["8.0 ± 1.0", flat], ["9.0 ± 1.0", flat])
    assert rows["paper: L2DGS"][-2:] == ["31.9", "0.94"]


def test_methods_trained_on_brightened_frames_have_no_low_light_scores():
    brightened = member("mochi", "gamma", 0, 5.0) | {"scores": {"region_convention": "nsff"}}
    rows = rows_of(lowlight.markdown(tables.collect([*MEMBERS, brightened], lowlight.lowlight)))
    assert rows["mochi: gamma"] == rows["mean: gamma"] == ["–"] * 6


def test_points_of_a_grid_have_separate_rows():
    grid = [member("mochi", "a", seed, level, level=level) for seed in (0, 1) for level in (1.0, 2.0)]
    plain = member("mochi", "b", 0, 3.0, level=3.0)
    rows = tables.collect([*grid, plain], tables.welllit)["mochi"]
    assert {name: cells["dynamic"]["psnr"] for name, cells in rows.items()} == {
        "a, level 1.0": [1.0, 1.0],
        "a, level 2.0": [2.0, 2.0],
        "b": [3.0],
    }
    nameless = [one | {"variant": ""} for one in grid]
    assert set(labels(nameless).values()) == {"level 1.0", "level 2.0"}
    assert set(labels(nameless[:1]).values()) == {"the preset"}


def test_diverged_members_are_in_no_mean_and_are_named(tmp_path, capsys):
    diverged = [member("mochi", name, 1, 99.0, ended="diverged at step 7") for name in ("L2DGS", "without_exposure")]
    found = tables.collect([*MEMBERS, *diverged], tables.welllit)["mochi"]
    assert found["L2DGS"]["dynamic"]["psnr"] == [0.0, None, 2.0]
    assert rows_of(tables.table([(name, [cells]) for name, cells in found.items()]))["without_exposure"] == ["–"] * 6
    tables.write(tables.Options(tmp_path), "t", [*MEMBERS, *diverged], {}, "the table\n")
    *_, convention, _, named, _, seeds = (tmp_path / "t.md").read_text().splitlines()
    assert "nsff" in convention
    assert seeds == "Means over 3 seeds, ± half of the range."
    assert named.endswith(": mochi-L2DGS-1 (diverged at step 7), mochi-without_exposure-1 (diverged at step 7).")
    assert len(json.loads((tmp_path / "t.json").read_text())["left_out"]) == 2


@pytest.mark.slow
def test_lpips_is_added_to_members_that_were_scored_without_its_weights(tmp_path, tmp_path_factory, monkeypatch):
    monkeypatch.setitem(metrics.NETWORKS, "alex", networks.TINY)
    monkeypatch.setitem(SMALLEST_SIDE, "alex", 1)
    np.savez(tmp_path / "tiny.npz", **networks.state_dict("alex"))
    out = tmp_path / "out"
    members = [member("mochi", "a", 0, 5.0), member("mochi", "a", 1, 5.0, ended="diverged at step 7")]
    for one in members:
        shutil.copytree(finished_run.folder(tmp_path_factory.getbasetemp()), out / one["name"])
        (out / one["name"] / report.RESULT_FILE).write_text(json.dumps(one))
    (out / running.PLANS_FILE).write_text("[]")
    names = [one["name"] for one in members]
    monkeypatch.setattr(running, "run_study", lambda *_, **__: report.write(out, names))
    study = tmp_path / "study.toml"
    study.write_text('scenes = ["mochi"]')
    options = tables.Options(out, study, lpips_alex=(tmp_path / "tiny.npz",))
    first, second = tables.trained(options, "table1.toml")
    assert first["scores"]["region_convention"] == "paper"
    assert first["scores"]["welllit"]["overall"]["lpips_alex"] > 0
    assert second == members[1], "what diverged is in no table"
    monkeypatch.setattr(tables, "evaluate", None)
    assert tables.trained(options, "table1.toml") == [first, second], "nothing is scored again"
    with pytest.raises(UserError, match="missing"):
        tables.trained(tables.Options(out, study, lpips_alex=(tmp_path / "missing.npz",)), "table1.toml")


@pytest.mark.slow
def test_a_quick_table_is_resumed_without_training_again(tmp_path):
    write_nerfies(tmp_path / "mochi", 10, 24, 18, num_points=40, truth=True)
    study = tmp_path / "study.toml"
    study.write_text('scenes = ["mochi", "no"]\n[[variants]]\nname = "a"\npreset = "enhance-4dgs"\nenhance = "gamma"\n')
    command = [sys.executable, "-m", "experiments.table1", str(tmp_path / "out"), "--study", str(study), "--quick"]
    environment = os.environ | {"L2DGS_JAX_CACHE": str(tmp_path / "cache"), "PYTHONWARNINGS": "ignore"}
    printed = []
    for _ in range(2):
        ran = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
        assert (tmp_path / "out" / "table1.md").read_text() in ran.stdout
        printed.append(ran.stdout.partition("A smoke run")[2])
    assert printed[0] == printed[1] != ""
    found = json.loads((tmp_path / "out" / "table1.json").read_text())
    assert found["quick"]
    assert found["scenes"]["mochi"]["a"].keys() == {"dynamic", "static", "overall"}
    metrics = next((tmp_path / "out").glob("*mochi*")) / "metrics.jsonl"
    assert len(metrics.read_text().splitlines()) == 1, "nothing was trained again"
