"""Reading scenes from disk into arrays, and writing them."""

import dataclasses
import zipfile
from pathlib import Path
from types import ModuleType

import numpy as np

from l2dgs_jax.config import Config
from l2dgs_jax.data import colmap, demo, llff, nerfies, splits, transforms
from l2dgs_jax.data.dataset import Dataset, Source, Split
from l2dgs_jax.errors import UserError

__all__ = ["LAYOUTS", "Dataset", "Split", "load_dataset"]

# Each has recognizes(folder), read(folder, downscale, held_out, frame_memory) and write(dataset, folder). That of
# "nerfies" alone stores how to normalise the world, so its `read` alone can be told not to.
LAYOUTS: dict[str, ModuleType] = {"nerfies": nerfies, "colmap": colmap, "transforms": transforms, "llff": llff}


def load_dataset(
    scene: str | Path,
    downscale: int = 1,
    format: str = "auto",
    held_out: str = "auto",
    frame_memory: float = Config.frame_memory,
    normalise: bool = True,
) -> Dataset:
    """Read a scene in any of the known layouts.

    Args:
        scene: its folder, or "demo" for the clip that comes with the package.
        downscale: integer factor by which images are smaller than full size.
        format: a name in `LAYOUTS`, or "auto" to recognise the layout of the folder.
        held_out: which frames are not trained on, see `splits.hold_out`.
        frame_memory: GiB of memory for its frames; if they take more, they go to temporary files (`MappedArray`).
        normalise: whether the world is centred and scaled as the `scene.json` of the layout "nerfies" says.

    Raises:
        UserError: anything in the scene is missing, malformed or inconsistent.
    """
    if downscale < 1:
        raise UserError(f"--downscale {downscale}: expected a whole number from 1")
    if not frame_memory >= 0:
        raise UserError(f"--frame-memory {frame_memory}: expected GiB, from 0")
    splits.check_rule(held_out)
    name = "demo" if scene == "demo" else str(Path(scene).absolute())
    source = Source(name, downscale, format, held_out, float(frame_memory), normalise)
    folder = demo.FOLDER if scene == "demo" else Path(scene)
    if format not in ("auto", *LAYOUTS):
        raise UserError(f"--format {format}: no such layout; expected auto, {', '.join(LAYOUTS)}")
    try:
        if folder.is_file() and zipfile.is_zipfile(folder):
            raise UserError(f"{folder}: is a zip archive; expected a folder: unpack it first")
        if not folder.is_dir():
            raise UserError(f"{folder}: no such folder; expected a scene's folder, or 'demo'")
        if format == "auto":
            format = _recognized(folder)
        with np.errstate(all="ignore"):  # `assemble` rejects values that have overflowed
            options = {"normalise": normalise} if format == "nerfies" else {}
            dataset = LAYOUTS[format].read(folder, downscale, held_out, frame_memory, **options)
    except OSError as error:
        raise UserError(f"{error.filename or folder}: {error.strerror}; expected files that can be read") from None
    return dataclasses.replace(dataset, source=source)


def _recognized(folder: Path) -> str:
    """The one layout that the folder has."""
    if not any(folder.iterdir()):
        raise UserError(f"{folder}: the folder is empty; expected a scene")
    found = [name for name, layout in LAYOUTS.items() if layout.recognizes(folder)]
    if not found:
        raise UserError(
            f"{folder}: not a known layout; expected camera/ and rgb/ (Nerfies, HyperNeRF, DyCheck), sparse/ (COLMAP), "
            "transforms.json (nerfstudio, D-NeRF, Blender), or poses_bounds.npy (LLFF)"
        )
    if len(found) > 1:
        raise UserError(f"{folder}: holds the layouts {' and '.join(found)}; expected one, or --format with its name")
    return found[0]
