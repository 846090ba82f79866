"""The layout of Nerfies (arXiv 2011.12948), HyperNeRF, DyCheck (arXiv 2210.13445) and similar data sets.

    camera/<id>.json   rgb/<k>x/<id>.png   dataset.json   [metadata.json]   [scene.json]
    points.npy   [points_rgb.npy]

Brackets mark what is optional. The lists of `dataset.json` may be in `splits/{train,val}.json` instead. The alpha of
DyCheck's pictures says which pixels are valid.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from l2dgs_jax.data import splits
from l2dgs_jax.data.assembly import Frame, assemble
from l2dgs_jax.data.clouds import read_ply
from l2dgs_jax.data.dataset import Dataset
from l2dgs_jax.data.lens import Lens
from l2dgs_jax.data.parsing import numbers, read_array, read_json, rotation
from l2dgs_jax.data.pictures import Picture, stored
from l2dgs_jax.data.writing import write_lists, write_pictures
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.files import new_folder, write_json

DENSE_CLOUD = "points3D_downsample2.ply"  # as the scripts of 4DGaussians call it


def recognizes(folder: Path) -> bool:
    """Whether the folder has this layout."""
    return (folder / "camera").is_dir()


def read(folder: Path, downscale: int, held_out: str, frame_memory: float, normalise: bool = True) -> Dataset:
    """Read a scene.

    Args:
        folder: of the scene.
        downscale: integer factor by which images are smaller than full size.
        held_out: see `splits.hold_out`.
        frame_memory: see `assemble`.
        normalise: whether world coordinates X become (X - center) * scale, with center and scale from `scene.json`.

    Raises:
        UserError: a file is missing, malformed or inconsistent.
    """
    listed, own = splits.lists(folder)
    train, val, notes = splits.hold_out(f"{folder / 'dataset.json'}", listed, own, held_out, default="4dgs")
    times = splits.instants(folder, listed)
    center, scale = _normalization(folder) if normalise else (np.zeros(3), 1.0)
    points, colors = _points(folder)

    def frames(names: list[str]) -> list[Frame]:
        pictures = stored(folder / "rgb", downscale, names)
        return [
            _frame(folder, name, center, scale, times[name], picture)
            for name, picture in zip(names, pictures, strict=True)
        ]

    world = (points - center) * scale
    return assemble(folder, frames(train), frames(val), world, colors, downscale, frame_memory, notes)


def _normalization(folder: Path) -> tuple[Float64[np.ndarray, "3"], float]:
    """Center and scale of the scene."""
    path = folder / "scene.json"
    if not path.exists():
        return np.zeros(3), 1.0
    content = read_json(path, "center and scale")
    scale = float(numbers(path, content, "scale", ()))
    if scale <= 0:
        raise UserError(f"{path}: 'scale' is {scale}; expected a positive number")
    return numbers(path, content, "center", (3,)), scale


def _points(folder: Path) -> tuple[Float64[np.ndarray, "P 3"], Float32[np.ndarray, "P 3"] | None]:
    """Points as stored, and their colours from a file of their own or from columns 4 to 6.

    The dense cloud of 4DGS (arXiv 2310.08528) is preferred if it has been made.
    """
    if (folder / DENSE_CLOUD).is_file():
        points, colors = read_ply(folder / DENSE_CLOUD)
        return points.astype(np.float64), colors
    path = folder / "points.npy"
    rows = read_array(path, "the scene's surface points, shape (P, 3)")
    if rows.ndim != 2 or rows.shape[1] not in (3, 6) or not len(rows):
        raise UserError(f"{path}: the array has shape {rows.shape}; expected (P, 3) or (P, 6) with at least one point")
    colors_path = folder / "points_rgb.npy"
    if colors_path.exists():
        colors = read_array(colors_path, "the points' colours")
        if colors.shape != (len(rows), 3):
            raise UserError(f"{colors_path}: the array has shape {colors.shape}; expected {(len(rows), 3)}")
    elif rows.shape[1] == 6:
        colors_path, colors = path, rows[:, 3:]
    else:
        return rows.astype(np.float64), None
    if colors.min() < 0 or colors.max() > 255:
        raise UserError(f"{colors_path}: colours run from {colors.min()} to {colors.max()}; expected 0-1 or 0-255")
    unit = 255.0 if np.issubdtype(colors.dtype, np.integer) or colors.max() > 1 else 1.0
    return rows[:, :3].astype(np.float64), (colors / unit).astype(np.float32)


def _frame(
    folder: Path, name: str, center: Float64[np.ndarray, "3"], scale: float, time: float, image: Picture
) -> Frame:
    """A frame from its camera file."""
    path = folder / "camera" / f"{name}.json"
    content = read_json(path, f"the camera of frame '{name}'")
    tangential = "tangential" if "tangential" in content else "tangential_distortion"  # the first is the older key
    optional = {"skew": 0.0, "pixel_aspect_ratio": 1.0, "radial_distortion": [0.0] * 3, tangential: [0.0] * 2}
    content = optional | content

    turned = rotation(f"{path}: 'orientation'", numbers(path, content, "orientation", (3, 3)))
    position = (numbers(path, content, "position", (3,)) - center) * scale
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turned, -turned @ position

    focal, aspect = (float(numbers(path, content, key, ())) for key in ("focal_length", "pixel_aspect_ratio"))
    if focal <= 0 or aspect <= 0:
        raise UserError(
            f"{path}: 'focal_length' is {focal} and 'pixel_aspect_ratio' {aspect}; expected positive numbers"
        )
    skew = float(numbers(path, content, "skew", ()))
    u, v = numbers(path, content, "principal_point", (2,))
    k1, k2, k3 = numbers(path, content, "radial_distortion", (3,)).tolist()
    p1, p2 = numbers(path, content, tangential, (2,)).tolist()
    width, height = numbers(path, content, "image_size", (2,))
    if min(width, height) < 1 or width % 1 or height % 1:
        raise UserError(f"{path}: 'image_size' is {width} by {height}; expected whole positive numbers of pixels")
    return Frame(
        name=name,
        source=str(path),
        viewmat=viewmat,
        K=np.array([[focal, skew, u], [0, focal * aspect, v], [0, 0, 1]]),
        lens=Lens((k1, k2, k3), tangential=(p1, p2)),
        size=(int(width), int(height)),
        time=time,
        image=image,
    )


def write(dataset: Dataset, folder: Path) -> None:
    """Write a scene so that `read` gives it back: cameras, instants and points exactly, pictures rounded to 8 bits.

    Raises:
        UserError: the folder holds files already or cannot be written.
    """
    with new_folder(folder) as target:
        write_pictures(dataset, target / "rgb" / "1x", target)
        write_lists(dataset, target)
        write_json(target / "scene.json", {"center": [0.0, 0.0, 0.0], "scale": 1.0})
        np.save(target / "points.npy", dataset.points)
        if dataset.colors is not None:
            np.save(target / "points_rgb.npy", dataset.colors)
        for split in (dataset.train, dataset.test):
            for name, viewmat, K in zip(split.names, split.cameras.viewmat, split.cameras.K, strict=True):
                write_json(
                    target / "camera" / f"{name}.json",
                    _camera(np.asarray(viewmat, np.float64), np.asarray(K, np.float64))
                    | {"image_size": [dataset.width, dataset.height]},
                )


def _camera(viewmat: Float64[np.ndarray, "4 4"], K: Float64[np.ndarray, "3 3"]) -> dict[str, Any]:
    """A camera file without the size."""
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    return {
        "orientation": rotation.tolist(),
        "position": np.linalg.solve(rotation, -translation).tolist(),
        "focal_length": K[0, 0],
        "pixel_aspect_ratio": K[1, 1] / K[0, 0],
        "principal_point": K[:2, 2].tolist(),
        "skew": 0.0,
        "radial_distortion": [0.0] * 3,
        "tangential_distortion": [0.0] * 2,
    }
