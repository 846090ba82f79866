"""Figures of speed and memory in the documentation."""

import json
from pathlib import Path

import pytest

from experiments.benchmarks import table

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
