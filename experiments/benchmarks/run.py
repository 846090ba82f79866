"""Measure, and compare with the committed baseline: `python -m experiments.benchmarks.run [CASE ...]`."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from experiments.benchmarks.cases import CASES
from experiments.benchmarks.stopwatch import machine
from l2dgs_jax import devices
from l2dgs_jax.cli import use_huge_pages

BASELINE = Path(__file__).with_name("baseline.json")
TOLERANCE = 1.3  # machines are shared: a smaller ratio is noise


@dataclass
class Options:
    """Measure speed and memory; run it on idle cores."""

    cases: Annotated[tuple[str, ...], tyro.conf.Positional] = tuple(CASES)
    """Which to run: rasterizer, growth, folding, parts, step, rendering, compiling, memory, scale."""
    json: Path | None = None
    """Where to write the figures."""
    update: bool = False
    """Make them the baseline."""


def main() -> None:
    options = tyro.cli(Options)
    unknown = set(options.cases) - set(CASES)
    if unknown:
        raise SystemExit(f"error: no case {', '.join(sorted(unknown))}; expected some of {', '.join(CASES)}")
    use_huge_pages()
    devices.one_per_core()
    baseline = json.loads(BASELINE.read_text()) if BASELINE.exists() else {"machine": {}, "figures": {}}
    report = {"machine": machine(), "figures": {}}
    print(json.dumps(report["machine"]))
    if baseline["machine"] and baseline["machine"] != report["machine"]:
        print(f"the baseline is of another machine: {json.dumps(baseline['machine'])}")
    for case in options.cases:
        figures = CASES[case]()
        report["figures"][case] = {name: round(value, 3) for name, value in figures.items()}
        for name, value in figures.items():
            print(f"{case:12}{name:42}{value:12.3f}  {_verdict(value, baseline['figures'].get(case, {}).get(name))}")
    if options.json:
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    if options.update:
        merged = {"machine": report["machine"], "figures": baseline["figures"] | report["figures"]}
        BASELINE.write_text(json.dumps(merged, indent=2) + "\n")


def _verdict(value: float, baseline: float | None) -> str:
    if not baseline:
        return ""
    ratio = value / baseline
    return f"{ratio:5.2f} of the baseline{'' if 1 / TOLERANCE < ratio < TOLERANCE else '  <- differs'}"


if __name__ == "__main__":
    main()
