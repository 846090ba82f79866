"""Contact sheets: a few instants of a run at a glance."""

import jax
import numpy as np
from jaxtyping import UInt8

from l2dgs_jax.data.images import to_bytes
from l2dgs_jax.data.stacks import evenly_spread
from l2dgs_jax.runs.pictures import Output
from l2dgs_jax.runs.run import Run
from l2dgs_jax.visualize import display
from l2dgs_jax.visualize.sheet import sheet

COLUMNS = ("input", "low-light", "well-lit", "truth", "L", "R", "B1", "B2", "depth")
RENDERED: dict[str, Output] = {
    "low-light": "lowlight",
    "well-lit": "welllit",
    "L": "illumination",
    "R": "reflectance",
    "B1": "b1",
    "B2": "b2",
    "depth": "depth",
}


def contact_sheet(run: Run, rows: int = 4) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures of a few instants, one per row, in the columns of `COLUMNS`; "truth" only if the scene has it.

    L and R are shown as they are. B1, B2 and depth are colour-mapped (viridis) from their 2nd to their 98th percentile
    over all rows; their headings state this range.

    Args:
        run: the run.
        rows: how many views, spread over time; held-out views if the scene has some.
    """
    dataset = run.dataset
    held_out = len(dataset.test.names) > 0
    split = dataset.test if held_out else dataset.train
    in_time = np.argsort(split.cameras.time, kind="stable")
    chosen = in_time[evenly_spread(len(in_time), rows)].tolist()
    renderer = run.renderer()
    outputs = [jax.device_get(renderer(split.camera(i))) for i in chosen]

    ranges = display.ranges(outputs)
    columns = [name for name in COLUMNS if name != "truth" or split.welllit is not None]
    headings = [_heading(name, ranges) for name in columns]

    lines = []
    kind = "held out" if held_out else "trained on"
    for row, i in enumerate(chosen):
        pictures = {name: display.shown(outputs[row], kind, ranges) for name, kind in RENDERED.items()}
        pictures["input"] = to_bytes(split.images[i])
        if split.welllit is not None:
            pictures["truth"] = to_bytes(split.welllit[i])
        caption = f"{split.names[i]}, time {split.cameras.time[i]:.2f}, {kind}"
        lines.append((caption, [pictures[name] for name in columns]))
    return sheet(headings, lines)


def _heading(name: str, ranges: display.Ranges) -> str:
    span = ranges.get(RENDERED[name]) if name in RENDERED else None
    return f"{name} {span[0]:.5g}-{span[1]:.5g}" if span else name
