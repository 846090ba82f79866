"""`python -m experiments.benchmarks.table BASELINE`: the tables of docs/speed.md, from the figures of a machine."""

import itertools
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import tyro

from experiments.benchmarks.cases import FRAME_PLACES, LARGE_SCENES, scale_name

Figures = dict[str, dict[str, float]]  # by case and name
TABLES = {
    "Rasterizer": {
        "forward": "rasterizer 50k_800x450_forward_ms",
        "with gradients": "rasterizer 50k_800x450_forward_backward_ms",
        "the C blend, forward": "rasterizer 50k_800x450_native_forward_ms",
        "the C blend, with gradients": "rasterizer 50k_800x450_native_forward_backward_ms",
        "the rasterizer over the C blend, with gradients": "rasterizer 50k_800x450_over_native",
        "10,000 Gaussians at 160x96, with gradients": "rasterizer 10k_160x96_forward_backward_ms",
        "the C blend of those, with gradients": "rasterizer 10k_160x96_native_forward_backward_ms",
        "a million (Gaussian, tile) pairs, 5,000 Gaussians at 800x450": "growth 5k_800x450_ms_per_million_pairs",
        "a million pairs, 50,000 Gaussians at 400x225": "growth 50k_400x225_ms_per_million_pairs",
        "a million pairs, 200,000 Gaussians at 200x112": "growth 200k_200x112_ms_per_million_pairs",
        "four scenes in one vmapped call, over one after the other": "folding vmapped_over_one_by_one",
    },
    "Training and rendering": {
        "whole training step": "step 40k_400x225_ms",
        "10,000 Gaussians at 200x112": "step 10k_200x112_ms",
        "50,000 Gaussians at 800x450": "step 50k_800x450_ms",
        "the motion field acting on a tenth of them": "step 40k_400x225_tenth_moving_ms",
        "without paths": "step 40k_400x225_without_paths_ms",
        "without gates": "step 40k_400x225_without_gates_ms",
        "its parts on one device: HexPlane": "parts hexplane_ms",
        "heads and OCD-Net": "parts heads_and_ocd_ms",
        "rasterizer": "parts rasterizer_ms",
        "BAFE-Net, in presets that have it": "parts bafe_ms",
        "Adam": "parts adam_ms",
        "rendering well-lit frames": "rendering welllit_frames_per_s",
        "the motion field acting on a tenth of the Gaussians": "rendering tenth_moving_welllit_frames_per_s",
        "before the first step of the demo (39 frames, 256x192): flow for views in between": "seeding demo_flow_ms",
        "tracks of moving objects, with their flow": "seeding demo_flow_and_seeds_ms",
        "points on static surfaces": "seeding demo_surfaces_ms",
        "peak memory of steps at 800x450 with 50,000 Gaussians": "memory 50k_800x450_peak_gib",
        "growth of memory over 1,000 steps of a small scene": "memory thousand_steps_growth_gib",
        "first step of the coarse stage in a new process, compilation cache empty": "compiling coarse_cold_s",
        "compilation cache filled": "compiling coarse_cached_s",
        "first step of the fine stage, compilation cache empty": "compiling fine_cold_s",
        "compilation cache filled, fine stage": "compiling fine_cached_s",
    },
}
ACCELERATOR_TABLES = {
    "GPU": {
        "rasterizer, forward": "rasterizer 50k_800x450_forward_ms",
        "with gradients": "rasterizer 50k_800x450_forward_backward_ms",
        "10,000 Gaussians at 160x96, with gradients": "rasterizer 10k_160x96_forward_backward_ms",
        "whole training step": "step 40k_400x225_ms",
        "the motion field acting on a tenth of the Gaussians": "step 40k_400x225_tenth_moving_ms",
        "parts of the step: HexPlane": "parts hexplane_ms",
        "heads and OCD-Net": "parts heads_and_ocd_ms",
        "rasterizer": "parts rasterizer_ms",
        "BAFE-Net, in presets that have it": "parts bafe_ms",
        "Adam": "parts adam_ms",
        "rendering well-lit frames": "rendering welllit_frames_per_s",
        "the same, where a tenth of the Gaussians move": "rendering tenth_moving_welllit_frames_per_s",
        "one at a time, all moving": "rendering welllit_one_at_a_time_frames_per_s",
    },
}
UNITS = {"_per_s": " a second", "_ms_per_million_pairs": " ms", "_ms": " ms", "_gib": " GiB", "_s": " s"}


def markdown(title: str, figures: Figures) -> str:
    """One of `TABLES` or `ACCELERATOR_TABLES`, as Markdown, with the rows that have figures; empty if none has."""
    rows = []
    for label, where in (TABLES | ACCELERATOR_TABLES)[title].items():
        case, name = where.split()
        if name in figures.get(case, {}):
            rows.append(f"| {label} | {shown(name, figures[case][name])} |")
    return _lines(["| | |", "|---|---|"], rows)


def larger_scenes(figures: Figures) -> str:
    """A table with a row for each of `LARGE_SCENES` and each place of its frames; empty without figures."""
    rows = []
    for size, place in itertools.product(LARGE_SCENES, FRAME_PLACES):
        count, frames, width, height = size
        name = scale_name(*size, place)
        if f"{name}_ms" in figures.get("scale", {}):
            found = (shown(unit, figures["scale"][f"{name}{unit}"]) for unit in ("_ms", "_peak_gib"))
            rows.append(f"| {count:,} | {frames:,} | {width}x{height} | {place} | {' | '.join(found)} |")
    return _lines(["| Gaussians | frames | size | frames lie in | step | peak |", "|---|---|---|---|---|---|"], rows)


def _lines(heading: Sequence[str], rows: Sequence[str]) -> str:
    return "".join(f"{row}\n" for row in (*heading, *rows)) if rows else ""


def shown(name: str, value: float) -> str:
    """A figure with its unit, rounded to two digits: measurements on a shared machine are not more precise."""
    unit = next((unit for ending, unit in UNITS.items() if name.endswith(ending)), "")
    return f"{value:.0f}{unit}" if value >= 10 else f"{float(f'{value:.2g}'):g}{unit}"


def main(baseline: tyro.conf.Positional[Path]) -> None:
    """Print the tables, without rows for cases that have not been measured.

    Args:
        baseline: file that `run --update` has written.
    """
    report = json.loads(baseline.read_text())
    figures, on_cpu = report["figures"], report["machine"]["device"] == "cpu"
    tables = {title: markdown(title, figures) for title in (TABLES if on_cpu else ACCELERATOR_TABLES)}
    if on_cpu:
        tables["Larger scenes"] = larger_scenes(figures)
    sys.stdout.write("\n".join(f"## {title}\n\n{table}" for title, table in tables.items() if table))


if __name__ == "__main__":
    tyro.cli(main)
