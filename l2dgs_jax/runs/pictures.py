"""The views of a run as picture files, one folder for each kind of picture, resumed where they were left."""

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
RECORD = "render.json"
DEPTH_UNIT = "depth.json"
EXPONENT_UNIT = 10 / 65535  # of b1 and b2 in 16 bits; exponents lie between 1 and 10

Pictures = dict[str, Shaped[np.ndarray, "H W *C"]]  # by kind


def values(output: RenderOutput, kind: Output) -> Float[np.ndarray, "H W *C"]:
    """One output of a view: sRGB values or parts in [0, 1], exponents from 1 to 10, or mean depth in world units."""
    if kind == "depth":
        return expected_depth(output)
    if kind == "alpha":
        return np.asarray(output.alpha)
    if kind in ("b1", "b2"):
        return np.asarray(output.images.attenuation)[..., ("b1", "b2").index(kind)]
    return np.asarray(getattr(output.images, kind))


def as_integers(output: RenderOutput, kinds: Sequence[Output]) -> Pictures:
    """For PNG: 8 bits of what lies in [0, 1], 16 of exponents, in units of 10 / 65535; depth stays as it is."""
    pictures: Pictures = {}
    for kind in kinds:
        pictures[kind] = values(output, kind)
        if kind in ("b1", "b2"):
            pictures[kind] = np.round(pictures[kind] / EXPONENT_UNIT).astype(np.uint16)
        elif kind != "depth":
            pictures[kind] = to_bytes(pictures[kind])
    return pictures


def as_floats(output: RenderOutput, kinds: Sequence[Output]) -> Pictures:
    """For EXR: linear light of well-lit and low-light images, as the format has it; all others as they are."""
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

    Depth in PNG files has 16 bits: a value v stands for v * unit, in the units of the scene's cameras, with the unit in
    `depth.json`; 0 means that nothing is there.

    Args:
        run: the run.
        shots: what to render.
        folder: to write to; its `render.json` says what its frames depend on.
        kinds: what `draw` makes pictures of.
        draw: pictures of a view, by kind; depth to be scaled is a picture of floats.
        suffix: of the files.

    Returns:
        How many cameras were rendered now.

    Raises:
        UserError: the folder holds frames rendered otherwise, or a file cannot be written.
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
    """What frames depend on."""
    width, height = shots.size
    return {
        "scene": _digest([run.state.step, run.state.scene]),
        "cameras": _digest(shots.cameras),
        "size": f"{width}x{height}",
        "format": suffix[1:],
    }


def _claim(folder: Path, kinds: Sequence[str], record: dict[str, Any]) -> None:
    """Leave the record in the folder; or make sure that the frames that are there have the same."""
    path, advice = folder / RECORD, "remove the folder, or name another with --output"
    if path.exists():
        found = read_json(path, "what its frames depend on")
        differing = [key for key in record if found.get(key) != record[key]]
        if differing:
            raise UserError(f"{folder}: holds frames of another {' and '.join(differing)}; expected the same: {advice}")
    elif any((folder / kind).exists() for kind in kinds):
        raise UserError(f"{folder}: holds frames, but no {RECORD} that says of what; expected both, or none: {advice}")
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
    """Turn depths that wait as floats into pictures, in one unit for all, so that the depth of a video is steady."""
    waiting = {name: folder / "depth" / f"{name}.npy" for name in names}
    waiting = {name: array for name, array in waiting.items() if array.exists()}
    if not waiting:
        return
    path = folder / DEPTH_UNIT
    if not path.exists():
        unit = max([1e-12, *(float(np.load(array).max()) for array in waiting.values())]) / 65535
        write_json(path, {"unit": unit, "meaning": "depth = value * unit, 0 where empty"})
    unit = float(numbers(path, read_json(path, "the unit of depth"), "unit", ()))
    for name, array in waiting.items():
        scaled = np.clip(np.round(np.load(array) / unit), 0, 65535)
        write_image(folder / "depth" / f"{name}.png", scaled.astype(np.uint16))
        array.unlink()
