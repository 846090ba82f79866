"""The views of a run as picture files."""

from pathlib import Path

import numpy as np

from l2dgs_jax.data.dataset import Split
from l2dgs_jax.data.images import to_bytes, write_image
from l2dgs_jax.model.rendering import expected_depth
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runs.views import views
from l2dgs_jax.runtime.files import make_folder, write_json

KINDS = ("welllit", "lowlight", "illumination", "reflectance", "depth")


def write_views(run: Run, split: Split, folder: Path) -> None:
    """Render every view of `split` into `folder`: {welllit,lowlight,illumination,reflectance,depth}/NAME.png.

    Depth has 16 bits: a value v stands for v * unit, in the units of the scene's cameras, with the unit in
    `depth.json`; 0 means that nothing is there.

    Raises:
        UserError: a file cannot be written.
    """
    for kind in KINDS:
        for name in split.names:
            make_folder((folder / kind / name).parent)
    depths = []
    for name, output in zip(split.names, views(run, split), strict=True):
        for kind in KINDS[:-1]:
            write_image(folder / kind / f"{name}.png", to_bytes(getattr(output.images, kind)))
        depths.append(expected_depth(output))

    # One unit for all views, so that the depth of a video does not flicker.
    unit = max(float(max(depth.max() for depth in depths)), 1e-12) / 65535
    for name, depth in zip(split.names, depths, strict=True):
        write_image(folder / "depth" / f"{name}.png", np.round(depth / unit).astype(np.uint16))
    write_json(folder / "depth.json", {"unit": unit, "meaning": "depth = value * unit, 0 where empty"})
