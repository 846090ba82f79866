"""Figures of speed and memory in the documentation."""

import json
from pathlib import Path

import pytest

from experiments.benchmarks import run, table

ROOT = Path(__file__).parents[2]
BASELINES = ROOT / "experiments" / "benchmarks" / "baselines"
BASELINE = BASELINES / "amd-epyc-2-cores.json"


@pytest.mark.parametrize(
    ("name", "value", "shown"),
    [
        ("forward_ms", 6.682, "6.7 ms"),
        ("forward_ms", 1073.0, "1073 ms"),
        ("5k_ms_per_million_pairs", 454.683, "455 ms"),
        ("peak_gib", 2.423, "2.4 GiB"),
        ("growth_gib", 0.0, "0 GiB"),
        ("welllit_frames_per_s", 17.826, "18 a second"),
        ("over_native", 3.768, "3.8"),
    ],
)
def test_figures_are_rounded_and_have_their_unit(name, value, shown):
    assert table.shown(name, value) == shown


@pytest.mark.parametrize(
    ("title", "baseline"),
    [
        *((title, "amd-epyc-2-cores") for title in table.TABLES),
        *((title, "nvidia-h100-80gb-hbm3") for title in table.ACCELERATOR_TABLES),
    ],
)
def test_the_documentation_shows_what_was_measured(title, baseline):
    figures = json.loads((BASELINES / f"{baseline}.json").read_text())["figures"]
    assert table.markdown(title, figures) in (ROOT / "docs" / "speed.md").read_text()


def test_the_documentation_shows_what_was_measured_of_larger_scenes():
    figures = json.loads(BASELINE.read_text())["figures"]
    assert table.larger_scenes(figures) in (ROOT / "docs" / "speed.md").read_text()


@pytest.mark.parametrize("path", sorted(BASELINES.glob("*.json")), ids=lambda path: path.stem)
def test_the_tables_of_a_baseline_have_what_was_measured(path, capsys):
    table.main(path)
    baseline = json.loads(path.read_text())
    tables = table.TABLES if baseline["machine"]["device"] == "cpu" else table.ACCELERATOR_TABLES
    measured = {f"{case} {name}" for case, figures in baseline["figures"].items() for name in figures}
    known = {label for rows in tables.values() for label, where in rows.items() if where in measured}
    sizes = {f"{count:,}" for count, *_ in table.LARGE_SCENES} if "scale" in baseline["figures"] else set()
    printed = capsys.readouterr().out
    shown = {line.split(" | ")[0].removeprefix("| ") for line in printed.splitlines() if line.startswith("| ")}
    assert shown - {"|", "Gaussians"} == known | sizes
    assert "\n\n\n" not in printed, "a table is empty"
    assert not printed.endswith("\n\n"), "the last table is empty"


@pytest.mark.parametrize(
    ("name", "better", "baseline", "worse"),
    [
        ("forward_ms", 12.9, 10.0, 13.1),
        ("frames_per_s", 7.8, 10.0, 7.6),
        ("peak_gib", 2.5, 2.0, 2.7),
        ("growth_gib", 0.09, 0.0, 0.11),
        ("growth_gib", -1.0, -0.01, 0.1),
    ],
)
def test_a_figure_is_worse_by_more_than_a_tolerance(name, better, baseline, worse):
    assert [run.compare(f"a_{name}", value, baseline)[1] for value in (better, worse)] == [False, True]
    assert run.compare(f"a_{name}", worse, None) == ("", False)


HERE = {"processor": "One", "cores": 2, "device": "cpu", "jax": "2"}


@pytest.fixture
def benchmark(tmp_path, monkeypatch):
    """A function that runs the command with two cases that measure nothing; the baseline it works with."""
    monkeypatch.setattr(run, "BASELINES", tmp_path)
    monkeypatch.setattr(run, "CASES", {"memory": lambda: {"growth_gib": 0.5}, "step": lambda: {"small_ms": 3.0}})
    monkeypatch.setattr(run, "machine", lambda: HERE)
    monkeypatch.setattr(run, "use_huge_pages", lambda: None)

    def command(*arguments):
        monkeypatch.setattr("sys.argv", ["run", *arguments])
        run.main()

    return command, tmp_path / "one-2-cores.json"


def test_a_growth_from_nothing_is_found(benchmark, capsys):
    command, path = benchmark
    path.write_text(
        json.dumps({"machine": HERE, "figures": {"memory": {"growth_gib": 0.0}, "step": {"small_ms": 3.0}}})
    )
    command("step", "--check")
    with pytest.raises(SystemExit):
        command("memory", "step", "--check")
    assert capsys.readouterr().err == "worse than the baseline: memory growth_gib\n"


def test_a_check_needs_a_baseline_of_every_case(benchmark):
    command, path = benchmark
    path.write_text(json.dumps({"machine": HERE, "figures": {"step": {"small_ms": 3.0}}}))
    with pytest.raises(SystemExit, match=r"one-2-cores\.json has no memory; expected a baseline"):
        command("memory", "step", "--check")
    path.unlink()
    with pytest.raises(SystemExit, match="has no memory, step; expected"):
        command("memory", "step", "--check")


def test_figures_that_were_not_measured_again_keep_their_versions(benchmark):
    command, path = benchmark
    old = {"machine": HERE | {"jax": "1"}, "figures": {"memory": {"growth_gib": 0.0}}}
    path.write_text(json.dumps(old))
    with pytest.raises(SystemExit, match=r"one-2-cores\.json holds memory of other versions"):
        command("step", "--update")
    assert json.loads(path.read_text()) == old
    command("memory", "--update")
    command("step", "--update")
    figures = {"memory": {"growth_gib": 0.5}, "step": {"small_ms": 3.0}}
    assert json.loads(path.read_text()) == {"machine": HERE, "figures": figures}
