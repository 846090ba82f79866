"""A few instants of a run at a glance."""

import jax
import numpy as np
from jaxtyping import UInt8

from l2dgs_jax.data.images import to_bytes
from l2dgs_jax.model.rendering import expected_depth
from l2dgs_jax.runs.run import Run
from l2dgs_jax.visualize.sheet import sheet, viridis

COLUMNS = ("input", "re-lit low light", "well-lit", "truth", "L", "R", "B1", "B2", "depth")


def contact_sheet(run: Run, rows: int = 4) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures of a few instants, one row each, in the columns of `COLUMNS`; the truth only where there is one.

    L and R are shown as they are. B1, B2 and depth are coloured (viridis) from their 2nd to their 98th percentile over
    all rows, the range that their heading states.

    Args:
        run: the run.
        rows: how many views, spread over time; held-out views if the scene has some.
    """
    dataset = run.dataset
    held_out = len(dataset.test.names) > 0
    split = dataset.test if held_out else dataset.train
    in_time = np.argsort(split.cameras.time, kind="stable")
    chosen = in_time[np.unique(np.linspace(0, len(in_time) - 1, rows).round().astype(int))].tolist()
    renderer = run.renderer()
    outputs = [jax.device_get(renderer(split.camera(i))) for i in chosen]

    exponents = np.stack([output.images.attenuation for output in outputs])
    depths = np.stack([expected_depth(output) for output in outputs])
    coloured = {"B1": exponents[..., 0], "B2": exponents[..., 1], "depth": depths}
    ranges = {name: np.percentile(values, (2, 98)) for name, values in coloured.items()}
    columns = [name for name in COLUMNS if name != "truth" or split.welllit is not None]
    headings = [f"{name} {ranges[name][0]:.5g}-{ranges[name][1]:.5g}" if name in ranges else name for name in columns]

    lines = []
    kind = "held out" if held_out else "trained on"
    for row, i in enumerate(chosen):
        images = outputs[row].images
        pictures = {
            "input": to_bytes(split.images[i]),
            "re-lit low light": to_bytes(images.lowlight),
            "well-lit": to_bytes(images.welllit),
            "L": to_bytes(np.repeat(images.illumination[..., None], 3, axis=-1)),
            "R": to_bytes(images.reflectance),
        } | {name: viridis(values[row], *ranges[name]) for name, values in coloured.items()}
        if split.welllit is not None:
            pictures["truth"] = to_bytes(split.welllit[i])
        caption = f"{split.names[i]}, time {split.cameras.time[i]:.2f}, {kind}"
        lines.append((caption, [pictures[name] for name in columns]))
    return sheet(headings, lines)
