"""Run benchmarks, compare with this machine's baseline: `python -m experiments.benchmarks.run [CASE ...] [--check]`."""

import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from experiments.benchmarks.cases import CASES
from experiments.benchmarks.stopwatch import machine
from l2dgs_jax.runtime import devices
from l2dgs_jax.runtime.command_line import use_huge_pages

BASELINES = Path(__file__).with_name("baselines")
TOLERANCE = 1.3  # ratio to the baseline; smaller ones are noise, because machines are shared
GROWTH_TOLERANCE = 0.1  # GiB more than the baseline, which is near 0, so that a ratio to it would say nothing


@dataclass
class Options:
    """Measure speed and memory; run it on idle cores.

    Attributes:
        cases: which to run.
        json: file to write the figures to.
        check: exit with code 1 if a figure is worse than the baseline of this machine by more than the tolerance.
        update: make the figures the baseline of this machine.
    """

    cases: Annotated[tuple[str, ...], tyro.conf.Positional] = tuple(CASES)
    json: Path | None = None
    check: bool = False
    update: bool = False


def main() -> None:
    options = tyro.cli(Options)
    unknown = set(options.cases) - set(CASES)
    if unknown:
        raise SystemExit(f"error: no case {', '.join(sorted(unknown))}; expected some of {', '.join(CASES)}")
    use_huge_pages()
    devices.one_per_core()
    here = machine()
    path = BASELINES / f"{slug(here)}.json"
    baseline = json.loads(path.read_text()) if path.exists() else {"machine": here, "figures": {}}
    lacking = set(options.cases) - baseline["figures"].keys()
    if options.check and lacking:
        names = ", ".join(sorted(lacking))
        raise SystemExit(f"error: {path} has no {names}; expected a baseline of this machine: make it with --update")
    kept = baseline["figures"].keys() - set(options.cases)
    if options.update and kept and baseline["machine"] != here:
        raise SystemExit(
            f"error: {path} holds {', '.join(sorted(kept))} of other versions; expected --update with these cases too"
        )
    print(json.dumps(here))
    if baseline["machine"] != here:
        print(f"the baseline has other versions: {json.dumps(baseline['machine'])}")
    report: dict = {"machine": here, "figures": {}}
    worse = []
    for case in options.cases:
        figures = CASES[case]()
        report["figures"][case] = {name: round(value, 3) for name, value in figures.items()}
        for name, value in figures.items():
            verdict, is_worse = compare(name, value, baseline["figures"].get(case, {}).get(name))
            if is_worse:
                worse.append(f"{case} {name}")
                verdict += "  <- worse"
            print(f"{case:12}{name:42}{value:12.3f}  {verdict}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    if options.update:
        merged = {"machine": here, "figures": baseline["figures"] | report["figures"]}
        path.write_text(json.dumps(merged, indent=2) + "\n")
    if options.check and worse:
        print(f"worse than the baseline: {', '.join(worse)}", file=sys.stderr)
        sys.exit(1)


def slug(machine: dict[str, str | int]) -> str:
    """Name of the machine's baseline: its accelerator, or else its processor and cores."""
    name = f"{machine['processor']} {machine['cores']} cores" if machine["device"] == "cpu" else str(machine["device"])
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def compare(name: str, value: float, baseline: float | None) -> tuple[str, bool]:
    """How a figure compares with its baseline, if it has one, and whether it is worse by more than the tolerance."""
    if baseline is None:
        return "", False
    if name.endswith("growth_gib"):
        return f"{value - baseline:+5.2f} GiB to the baseline", value - baseline > GROWTH_TOLERANCE
    factor = baseline / value if name.endswith("_per_s") else value / baseline
    return f"{factor:5.2f} of the baseline", factor > TOLERANCE


if __name__ == "__main__":
    main()
