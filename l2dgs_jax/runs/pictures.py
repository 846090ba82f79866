"""Writing rendered views as picture files, one folder for each kind of output; existing files are kept."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float, Shaped

from l2dgs_jax.data.color import srgb_to_linear
from l2dgs_jax.data.images import to_bytes, write_image
from l2dgs_jax.data.parsing import numbers, read_json
from l2dgs_jax.errors import UserError
from l2dgs_jax.model.rendering import expected_depth
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runs.shots import Shots
from l2dgs_jax.runs.views import views
from l2dgs_jax.runtime.files import make_folder, replacing, write_json
from l2dgs_jax.types import Camera, RenderOutput

Output = Literal["welllit", "lowlight", "illumination", "reflectance", "b1", "b2", "depth", "alpha"]
RECORD_FILE = "render.json"
DEPTH_UNIT_FILE = "depth.json"
EXPONENT_UNIT = 10 / 65535  # of B1 and B2 as 16-bit integers; they lie between 1 and 10

Pictures = dict[str, Shaped[np.ndarray, "H W *C"]]  # by kind of output


def values(output: RenderOutput, kind: Output) -> Float[np.ndarray, "H W *C"]:
    """One output of a view: images, L, R and alpha in [0, 1], exponents in [1, 10], expected depth in world units."""
    if kind == "depth":
        return expected_depth(output)
    if kind == "alpha":
        return np.asarray(output.alpha)
    if kind in ("b1", "b2"):
        return np.asarray(output.images.attenuation)[..., ("b1", "b2").index(kind)]
    return np.asarray(getattr(output.images, kind))


def as_integers(output: RenderOutput, kinds: Sequence[Output]) -> Pictures:
    """Pictures for PNG: 8 bits for values in [0, 1], 16 bits for exponents in units of 10 / 65535, depth unchanged."""
    pictures: Pictures = {}
    for kind in kinds:
        pictures[kind] = values(output, kind)
        if kind in ("b1", "b2"):
            pictures[kind] = np.round(pictures[kind] / EXPONENT_UNIT).astype(np.uint16)
        elif kind != "depth":
            pictures[kind] = to_bytes(pictures[kind])
    return pictures


def as_floats(output: RenderOutput, kinds: Sequence[Output]) -> Pictures:
    """Pictures for EXR: well-lit and low-light images in linear light, as usual in that format; others unchanged."""
    images = {kind: np.asarray(values(output, kind), np.float32) for kind in kinds}
    lights = {kind: srgb_to_linear(image) for kind, image in images.items() if kind in ("welllit", "lowlight")}
    return {kind: np.asarray(image, np.float32) for kind, image in (images | lights).items()}


def write_frames(
    run: Run,
    shots: Shots,
    folder: Path,
    kinds: Sequence[str],
    draw: Callable[[RenderOutput], Pictures],
    suffix: Literal[".png", ".exr"] = ".png",
) -> int:
    """Render the cameras whose pictures `folder` does not hold yet, to KIND/NAME.png or .exr.

    Depth in PNG files has 16 bits: a value v means a depth of v * unit, in the units of the scene's cameras, and 0 that
    nothing is drawn; `depth.json` holds the unit.

    Args:
        run: the run.
        shots: what to render.
        folder: to write to; its `render.json` records what its frames depend on.
        kinds: keys of the pictures that `draw` returns.
        draw: the pictures of a view, by kind; for PNG, a picture of floats is a depth that is still to be scaled.
        suffix: of the files.

    Returns:
        How many cameras were rendered by this call.

    Raises:
        UserError: the folder holds frames of another scene, size or format, or a file cannot be written.
    """
    names = shots.names
    _claim(folder, kinds, _record(run, shots, suffix))
    for place in {(folder / kind / name).parent for kind in kinds for name in names}:
        make_folder(place)
    missing = [i for i, name in enumerate(names) if not all(_written(folder / kind, name, suffix) for kind in kinds)]
    chosen = Camera(*(x[np.array(missing, int)] for x in shots.cameras))
    for i, output in zip(missing, views(run, chosen, shots.size), strict=True):
        for kind, picture in draw(output).items():
            if suffix == ".png" and picture.dtype.kind == "f":
                _save(folder / kind / f"{names[i]}.npy", picture)
            else:
                write_image(folder / kind / f"{names[i]}{suffix}", picture)
    if suffix == ".png" and "depth" in kinds:
        _scale_depths(folder, names)
    return len(missing)


def _record(run: Run, shots: Shots, suffix: str) -> dict[str, Any]:
    """What the frames of a folder depend on."""
    width, height = shots.size
    return {
        "scene": _digest([run.state.step, run.state.scene]),
        "cameras": _digest(shots.cameras),
        "size": f"{width}x{height}",
        "format": suffix[1:],
    }


def _claim(folder: Path, kinds: Sequence[str], record: dict[str, Any]) -> None:
    """Write the record to the folder, or check that the frames that it already holds have the same record."""
    path, advice = folder / RECORD_FILE, "remove the folder, or name another with --output"
    if path.exists():
        found = read_json(path, "what its frames depend on")
        differing = [key for key in record if found.get(key) != record[key]]
        if differing:
            raise UserError(f"{folder}: holds frames of another {' and '.join(differing)}; expected the same: {advice}")
    elif any((folder / kind).exists() for kind in kinds):
        raise UserError(f"{folder}: holds frames without a {RECORD_FILE}; expected both or neither: {advice}")
    else:
        write_json(path, record)


def _digest(arrays: Any) -> str:
    total = hashlib.sha256()
    for leaf in jax.tree.leaves(arrays):
        total.update(np.ascontiguousarray(leaf).tobytes())
    return total.hexdigest()[:16]


def _written(folder: Path, name: str, suffix: str) -> bool:
    return any((folder / f"{name}{ending}").exists() for ending in (suffix, ".npy"))


def _save(path: Path, array: np.ndarray) -> None:
    with replacing(path) as temporary:
        np.save(temporary, array)


def _scale_depths(folder: Path, names: Sequence[str]) -> None:
    """Turn depths stored as floats into pictures, in one unit for all, so that depth does not flicker in a video."""
    waiting = {name: folder / "depth" / f"{name}.npy" for name in names}
    waiting = {name: array for name, array in waiting.items() if array.exists()}
    if not waiting:
        return
    path = folder / DEPTH_UNIT_FILE
    if not path.exists():
        unit = max([1e-12, *(float(np.load(array).max()) for array in waiting.values())]) / 65535
        write_json(path, {"unit": unit, "meaning": "depth = value * unit, 0 where empty"})
    unit = float(numbers(path, read_json(path, "the unit of depth"), "unit", ()))
    for name, array in waiting.items():
        scaled = np.clip(np.round(np.load(array) / unit), 0, 65535)
        write_image(folder / "depth" / f"{name}.png", scaled.astype(np.uint16))
        array.unlink()
