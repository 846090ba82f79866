"""The record of quality: its studies can be read, and its table says what they found."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from experiments import lowlight, table1, table3
from experiments.markdown import percentages
from experiments.published import TABLE3
from experiments.quality import compare_poses, table
from l2dgs_jax.config import PRESETS, overrides, to_dict
from l2dgs_jax.errors import UserError
from l2dgs_jax.study import spec

ROOT = Path(__file__).parents[2]
RECORD = ROOT / "experiments" / "quality"
STUDIES, RESULTS = sorted(RECORD.glob("studies/*.toml")), sorted(RECORD.glob("results/*.json"))


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_studies_of_the_record_can_be_read(path):
    plans = spec.read(path).plans
    assert {plan.varied["seed"] for plan in plans} == {0, 1, 2}
    assert all(plan.config.downscale == 2 for plan in plans)


def member(scene, seed, inbetweens, psnr, ended="finished", variant="", gain="none"):
    scores = {"lowlight": {"psnr": psnr, "ssim": 0.9}, "lowlight_gain": gain, "gaussians": 10}
    name = "-".join(map(str, (scene, seed, *inbetweens, *filter(None, [variant]))))
    found = {"name": name, "scene": f"/scenes/{scene}", "variant": variant, "varied": {"seed": seed, **inbetweens}}
    return found | {"ended": ended, "scores": scores}


def write_study(folder, members, settings=None):
    """What `sweep` would have left of a study in which all members have these settings besides."""
    folder.mkdir(exist_ok=True)
    (folder / "results.json").write_text(json.dumps({"members": members}))
    configs = [overrides.replace(PRESETS["default"], member["varied"] | (settings or {})) for member in members]
    plans = [{"name": m["name"], "settings": to_dict(config)} for m, config in zip(members, configs, strict=True)]
    (folder / "study.json").write_text(json.dumps(plans))
    return folder


def test_the_table_has_means_and_spreads_over_seeds(tmp_path):
    without, found = {"inbetweens": 0.0}, {"first": [], "second": []}
    found["first"] += [member("toys", seed, {}, psnr) for seed, psnr in enumerate((36.0, 36.5, 37.0))]
    found["second"] += [member("toys", seed, without, psnr) for seed, psnr in enumerate((35.0, 35.2))]
    found["second"].append(member("room", 0, without, 30.0))
    for name, members in found.items():
        write_study(tmp_path / name, members)
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
    assert table.markdown(table.collect([tmp_path / "table.json"])) == ran.stdout


def test_a_seed_that_diverged_is_named_and_not_counted(tmp_path, capsys):
    ends = ("finished", "diverged at step 7")
    members = [member("toys", seed, {}, 36.0 + seed, ended) for seed, ended in enumerate(ends)]
    members.append(member("toys", 2, {"inbetweens": 0.0}, 35.0, ends[1]))
    write_study(tmp_path, members)
    assert table.markdown(table.collect([tmp_path])).splitlines()[2:] == [
        "| the preset | 1 | 36.00 |",
        "| inbetweens 0.0 | 0 |  |",
    ]
    named = capsys.readouterr().err
    assert "toys-1 (diverged at step 7)" in named
    assert "toys-2-inbetweens (diverged at step 7)" in named
    assert "toys-0" not in named


def test_the_same_scores_twice_are_refused_as_further_seeds(tmp_path):
    """They may be of the same runs, or of other settings that a file does not tell."""
    for name in ("first", "second"):
        write_study(tmp_path / name, [member("toys", 0, {}, 36.0)])
    (tmp_path / "kept.json").write_text('[{"settings": {}, "scenes": {"toys": {"low": [36.0]}}}]')
    for pair in (("first", "second"), ("first", "kept.json"), ("kept.json", "first"), ("kept.json", "kept.json")):
        with pytest.raises(UserError, match=f"{pair[1]}: has scores of the preset on toys"):
            table.collect([tmp_path / name for name in pair])


def test_one_row_of_different_settings_is_refused(tmp_path):
    first = write_study(tmp_path / "first", [member("toys", 0, {}, 36.0)], {"loss.ssim": 0.5})
    second = write_study(tmp_path / "second", [member("room", 1, {}, 30.0)], {"loss.ssim": 0.25})
    same = write_study(tmp_path / "same", [member("room", 1, {}, 30.0)], {"loss.ssim": 0.5})
    other = write_study(tmp_path / "other", [member("room", 1, {}, 30.0, variant="weak")], {"loss.ssim": 0.25})
    with pytest.raises(UserError) as caught:
        table.collect([first, second])
    assert str(caught.value) == (
        f"{second}: loss.ssim is 0.25 for the preset, but 0.5 in {first}; "
        "expected studies with the same settings, or with variants of other names"
    )
    assert table.collect([first, same]) == {(): {"toys": {"low": [36.0]}, "room": {"low": [30.0]}}}
    assert [*table.collect([first, other])] == [(), (("", "weak"),)]
    (second / "study.json").write_text("{}")
    with pytest.raises(UserError, match=r"study\.json: cannot be read"):
        table.collect([second])


def test_variants_without_settings_of_their_own_are_no_seeds_of_one_row(tmp_path):
    write_study(tmp_path, [member("toys", 0, {}, psnr, variant=name) for name, psnr in (("a", 36.0), ("b", 37.0))])
    shown = table.markdown(table.collect([tmp_path]))
    assert shown.splitlines()[2:] == ["| a | 1 | 36.00 |", "| b | 1 | 37.00 |"]
    table.main([str(tmp_path), "--json", str(tmp_path / "kept.json")])
    assert table.markdown(table.collect([tmp_path / "kept.json"])) == shown


def test_scores_after_gains_of_their_own_have_columns_of_their_own(tmp_path):
    drifting = {"model.exposure": "drifting"}
    write_study(tmp_path, [member("toys", 0, {}, 36.0), member("toys", 0, drifting, 38.0, gain="own")])
    found = table.collect([tmp_path])
    assert table.markdown(found).splitlines() == [
        "| toys | seeds | low | low (own gain) |",
        "| --- | --- | --- | --- |",
        "| the preset | 1 | 36.00 |  |",
        "| model.exposure drifting | 1 |  | 38.00 |",
    ]
    assert [line.split(" | ")[1] for line in table.brief(found).splitlines()[2:]] == [
        "36.0, – / – |",
        "38.0 (own gain), – / – |",
    ]


def test_scenes_of_one_name_are_no_seeds_of_one_scene(tmp_path):
    write_study(tmp_path, [member("a/toys", 0, {}, 10.0), member("b/toys", 0, {}, 30.0)])
    assert table.collect([tmp_path]) == {(): {"a/toys": {"low": [10.0]}, "b/toys": {"low": [30.0]}}}


def test_an_infinite_score_is_written_as_json(tmp_path):
    write_study(tmp_path, [member("toys", 0, {}, "Infinity")])
    table.main([str(tmp_path), "--json", str(tmp_path / "kept.json")])
    strict = json.loads((tmp_path / "kept.json").read_text(), parse_constant=pytest.fail)
    assert strict[0]["scenes"]["toys"]["low"] == ["Infinity"]


@pytest.mark.parametrize("content", ["[", "[1]", "[{}]", '[{"settings": {}, "scenes": ["none.json", 0]}]', '{"a": 1}'])
def test_files_that_are_no_record_are_refused(tmp_path, content):
    (tmp_path / "kept.json").write_text(content)
    with pytest.raises(UserError, match=r"(kept|none)\.json: cannot be read"):
        table.collect([tmp_path / "kept.json"])
    with pytest.raises(UserError, match=r"results\.json: no such file"):
        table.collect([tmp_path])


def test_a_brief_table_has_all_scenes_side_by_side():
    found = {
        (): {"toys": {"low": [36.0, 36.5], "gain": [24.0, 25.0], "SSIM": [0.9, 0.8]}, "shelf": {"low": [37.0]}},
        (("", "without tracks"),): {"shelf": {"low": [36.0]}},
    }
    assert table.brief(found).splitlines() == [
        "| low, gain / SSIM | toys | shelf |",
        "| --- | --- | --- |",
        "| the preset | 36.2, 24.5 / 0.85 | 37.0, – / – |",
        "| without tracks |  | 36.0, – / – |",
    ]


def test_a_single_combination_has_a_row_for_each_scene():
    found = {(): {"toys": {"low": [36.0, 36.5], "SSIM": [0.9, 0.8]}, "room": {"low": [37.0]}}}
    assert table.markdown(found).splitlines() == [
        "| the preset | seeds | low | SSIM |",
        "| --- | --- | --- | --- |",
        "| toys | 2 | 36.25 ± 0.25 | 0.850 ± 0.050 |",
        "| room | 1 | 37.00 |  |",
    ]


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_the_documentation_shows_what_was_measured(path):
    pages = [page.read_text() for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))]
    found = table.collect([path])
    assert all(scores for scenes in found.values() for scores in scenes.values())
    assert any(shown in page for page in pages for shown in (table.markdown(found), table.brief(found)))


@pytest.mark.parametrize(
    ("name", "shown"), [("distances", percentages), ("flows", percentages), ("prepared", compare_poses.markdown)]
)
def test_the_documentation_shows_what_was_measured_without_training(name, shown):
    pages = [page.read_text() for page in (ROOT / "docs").glob("*.md")]
    assert any(shown(json.loads((RECORD / f"{name}.json").read_text())) in page for page in pages)


def test_the_documentation_shows_table_3_as_measured():
    rows = json.loads((ROOT / "experiments/studies/results/table3.json").read_text())["rows"]
    assert list(rows) == list(TABLE3)
    assert table3.markdown(rows) in (ROOT / "docs" / "ablations.md").read_text()


def test_the_documentation_shows_table_1_as_measured():
    scenes = json.loads((ROOT / "experiments/studies/results/table1.json").read_text())["scenes"]
    assert table1.markdown(scenes) in (ROOT / "docs" / "comparison.md").read_text()
    for scene, methods in scenes.items():
        for region in methods["L2DGS"]:
            for measure in ("ssim", "ssim_gain", "psnr_gain"):
                worst = min(methods["L2DGS"][region][measure])
                others = [methods[name][region][measure] for name in methods if name != "L2DGS"]
                assert worst > max(map(max, others)), f"{scene}: {measure} of the {region} region"


def test_the_documentation_shows_the_scores_of_the_dark_input_as_measured():
    scenes = json.loads((ROOT / "experiments/studies/results/lowlight.json").read_text())["scenes"]
    assert lowlight.markdown(scenes) in (ROOT / "docs" / "comparison.md").read_text()
