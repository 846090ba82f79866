"""Depth maps that come with a scene: measured, or estimated by a network from single pictures.

    depth/<k>x/<name>.npy       distances along the optical axis, in any unit
    disparity/<k>x/<name>.npy   their inverses, up to any scale and shift, as MiDaS gives them (arXiv 1907.01341)

Arrays are [H W] or [H W 1]; 16-bit PNG files can be used instead. Values that are not finite or not positive mean
unknown. If both folders exist, `depth/` is used.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from l2dgs_jax.cameras.geometry import points_inside
from l2dgs_jax.data.images import read_image
from l2dgs_jax.data.parsing import read_array
from l2dgs_jax.data.pictures import Picture, by_name, only, scales
from l2dgs_jax.errors import UserError
from l2dgs_jax.types import Camera

FOLDERS = {"depth": False, "disparity": True}  # whether they hold inverse depth
SUFFIXES = (".npy", ".png")
LARGEST_DEPTH = 1e18  # its square must fit into single precision too
SAMPLED_FRAMES = 8  # by `agreement`


def find(folder: Path, downscale: int, names: Sequence[str]) -> tuple[list[Picture | None], bool, list[str]]:
    """Each frame's map for the largest k that divides `downscale`, whether these hold inverse depth, and notes.

    Frames without a map have None, because DyCheck has depth of the training camera only; if no frame has a map, the
    list is empty.

    Raises:
        UserError: a frame has two maps.
    """
    notes = []
    for kind, inverse in FOLDERS.items():
        root = folder / kind
        if not root.is_dir():
            continue
        held, scale = scales(root, downscale)
        if not scale:
            notes.append(f"{root.name}/ holds {held}: not used at --downscale {downscale}")
            continue
        files = by_name(root / f"{scale}x", SUFFIXES)
        missing = [name for name in names if name not in files]
        if missing:
            some = f"{len(names) - len(missing)} of {len(names)} frames, but not of '{missing[0]}'"
            notes.append(f"{root.name}/{scale}x/ has depth of {some}: unknown there")
        if len(missing) == len(names):
            continue
        return [Picture(only(files[name]), scale) if name in files else None for name in names], inverse, notes
    return [], False, notes


def read(path: Path, inverse: bool) -> Float32[np.ndarray, "h w"]:
    """Inverse depth, 0 where unknown, from a file that holds it or its inverse.

    Raises:
        UserError: the file cannot be read or has another shape.
    """
    if path.suffix.lower() == ".png":
        picture = read_image(path)
        if np.ptp(picture, axis=-1).any():
            raise UserError(f"{path}: is a coloured picture of depth; expected grey values, or an array in .npy")
        values = picture[..., 0]
    else:
        values = read_array(path, "depth, shape (H, W) or (H, W, 1)", finite=False)
        if values.ndim not in (2, 3) or values.shape[2:] not in ((), (1,)):
            raise UserError(f"{path}: the array has shape {values.shape}; expected (H, W) or (H, W, 1)")
        values = values.reshape(values.shape[:2]).astype(np.float64)
    known = (values > 1 / LARGEST_DEPTH) & (values < LARGEST_DEPTH)
    values = np.where(known, values, 1)
    return np.where(known, values if inverse else 1 / values, 0).astype(np.float32)


def agreement(depths: Float32[np.ndarray, "F H W"], cameras: Camera, points: Float[np.ndarray, "P 3"]) -> float:
    """Correlation of the logarithms of given depth and of the points' depth: the median over some frames.

    0 if there is nothing to compare. It is negative where inverse depth was given by mistake.
    """
    found = []
    for frame in range(0, len(depths), -(-len(depths) // SAMPLED_FRAMES)):
        pairs = np.log(at_points(depths[frame], points, *(np.asarray(x[frame]) for x in cameras[:2])))
        if pairs.shape[1] > 1 and pairs.std(1).all():
            found.append(np.corrcoef(pairs)[0, 1])
    return float(np.median(found)) if found else 0.0


def at_points(
    depth: Float[np.ndarray, "H W"],
    points: Float[np.ndarray, "P 3"],
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, "2 S"]:
    """Given depth (0 where unknown) and the points' own, for those in view where it is known; occlusion is ignored."""
    _, pixels, distances = points_inside(points, viewmat, K, depth.shape[::-1])
    columns, rows = pixels.astype(int).T
    told = depth[rows, columns]
    return np.stack([told, distances])[:, told > 0]
