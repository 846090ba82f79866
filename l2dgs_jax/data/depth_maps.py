"""Depth that a user has: measured, or what a network makes of single pictures.

    depth/<k>x/<name>.npy       distances along the optical axis, in any unit
    disparity/<k>x/<name>.npy   their inverses, up to any scale and shift, as MiDaS gives them (arXiv 1907.01341)

Arrays are [H W] or [H W 1]; PNG files, of 16 bits, serve as well. Values that are not finite or not positive are
unknown. Where there are both, `depth/` counts.
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

FOLDERS = {"depth": False, "disparity": True}  # whether what they hold is inverse depth
SUFFIXES = (".npy", ".png")
LARGEST = 1e18  # squares must fit into single precision as well
LOOKED_AT = 8  # frames that `agreement` samples


def find(folder: Path, downscale: int, names: Sequence[str]) -> tuple[list[Picture | None], bool, list[str]]:
    """Each frame's map for the largest k that divides `downscale`, whether they are of inverse depth, and notes.

    An empty list if no frame has one.
    Some may be without: DyCheck's depth is of the camera that is trained on.

    Raises:
        UserError: a frame has two.
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
        values = read_image(path)[..., 0]
    else:
        values = read_array(path, "depth, shape (H, W) or (H, W, 1)", finite=False)
        if values.ndim not in (2, 3) or values.shape[2:] not in ((), (1,)):
            raise UserError(f"{path}: the array has shape {values.shape}; expected (H, W) or (H, W, 1)")
        values = values.reshape(values.shape[:2]).astype(np.float64)
    known = (values > 1 / LARGEST) & (values < LARGEST)
    values = np.where(known, values, 1)
    return np.where(known, values if inverse else 1 / values, 0).astype(np.float32)


def agreement(depths: Float32[np.ndarray, "F H W"], cameras: Camera, points: Float[np.ndarray, "P 3"]) -> float:
    """Correlation of depth with that of the points, logarithms of both, in the median of some frames.

    0 where there is nothing to compare. It tells depth from inverse depth, which are easily mistaken for each other.
    """
    height, width = depths.shape[1:]
    found = []
    for frame in range(0, len(depths), -(-len(depths) // LOOKED_AT)):
        depth = depths[frame]
        viewmat, K = (np.asarray(x[frame]) for x in (cameras.viewmat, cameras.K))
        _, pixels, distances = points_inside(points, viewmat, K, (width, height))
        columns, rows = pixels.astype(int).T
        told = depth[rows, columns]
        pairs = np.log(np.stack([told, distances])[:, told > 0])
        if pairs.shape[1] > 1 and pairs.std(1).all():
            found.append(np.corrcoef(pairs)[0, 1])
    return float(np.median(found)) if found else 0.0
