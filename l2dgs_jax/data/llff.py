"""The layout of LLFF (arXiv 1905.00889): `poses_bounds.npy` beside the pictures.

    poses_bounds.npy   [F, 17]: pose [3, 5] (axes down, right, back; position; height, width, focal length), near, far
    images/<name>, in the order of their names with suffix   [images_<k>/<name>, k times smaller]
    [a point cloud, see `clouds.find`, or else COLMAP's sparse/]
    [dataset.json]   [metadata.json]   as in the layout of Nerfies

Brackets mark what is optional. Alpha 0 marks pixels that do not count.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from l2dgs_jax.data import clouds, colmap_model, splits
from l2dgs_jax.data.assembly import Frame, assemble
from l2dgs_jax.data.dataset import Dataset
from l2dgs_jax.data.lens import Lens
from l2dgs_jax.data.parsing import read_array, rotation
from l2dgs_jax.data.pictures import Picture, by_name, copies, is_turned
from l2dgs_jax.data.writing import write_lists, write_pictures
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.files import new_folder

POSES_FILE = "poses_bounds.npy"
_AXES = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])  # (down, right, back) <-> (right, down, forward): its own inverse


def recognizes(folder: Path) -> bool:
    """Whether the folder has this layout, and no COLMAP model, which would hold more than the poses made from it."""
    return (folder / POSES_FILE).is_file() and colmap_model.find(folder) is None


def read(folder: Path, downscale: int, held_out: str, frame_memory: float) -> Dataset:
    """Read a scene; without a point cloud, random points fill the views between the near and far bounds.

    Args:
        folder: of the scene.
        downscale: integer factor by which images are smaller than full size.
        held_out: see `splits.hold_out`; without lists every eighth frame is held out.
        frame_memory: see `assemble`.

    Raises:
        UserError: a file is missing, malformed or inconsistent.
    """
    path, root = folder / POSES_FILE, folder / "images"
    rows = read_array(path, "the frames' poses and bounds, shape (F, 17)").astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise UserError(f"{path}: the array has shape {rows.shape}; expected (F, 17)")
    if not root.is_dir():
        raise UserError(f"{root}: no such folder; expected the scene's pictures")
    names = list(by_name(root))
    if len(names) != len(rows):
        raise UserError(f"{path}: has {len(rows)} poses for the {len(names)} pictures in {root}; expected one each")
    train, test, notes = splits.hold_out(str(path), names, splits.lists_beside(folder, names), held_out, default="8")
    times = splits.instants(folder, names)
    described = {name: _camera(f"{path}, row {i}", row) for i, (name, row) in enumerate(zip(names, rows, strict=True))}

    def frames(chosen: list[str]) -> list[Frame]:
        pictures = copies(folder, root, downscale, {name: name for name in chosen}, in_order=True)
        return [frame(name, picture) for name, picture in zip(chosen, pictures, strict=True)]

    def frame(name: str, picture: Picture) -> Frame:
        source, upright = f"{path}, row {names.index(name)}", is_turned(picture, described[name][-1])
        return Frame(name, source, *described[name], times[name], picture, upright=upright)

    model, cloud = colmap_model.find(folder), clouds.find(folder)
    if cloud is None and model:
        cloud = colmap_model.read_points(model)  # in the same world, because the poses come from this model
    if random := cloud is None:
        viewmats, Ks, _, sizes = zip(*described.values(), strict=True)
        cloud = clouds.in_frusta(np.stack(viewmats), np.stack(Ks), sizes[0], rows[:, 15:]), None
        stand_in = f"{clouds.RANDOM_POINTS} random points between the bounds stand in for one"
        notes = (*notes, f"{folder} has no point cloud: {stand_in}")
    return assemble(folder, frames(train), frames(test), *cloud, downscale, frame_memory, notes, random)


def write(dataset: Dataset, folder: Path) -> None:
    """Write a scene so that `read` gives it back; pictures get 8 bits.

    Raises:
        UserError: the layout cannot describe a camera; or the folder holds files already or cannot be written.
    """
    rows = {}
    for split in (dataset.train, dataset.test):
        for name, viewmat, K in zip(split.names, split.cameras.viewmat, split.cameras.K, strict=True):
            if K[0, 0] != K[1, 1] or K[0, 2] != dataset.width / 2 or K[1, 2] != dataset.height / 2:
                raise UserError(f"--to llff: the camera of '{name}' is off centre or has oblong pixels; expected none")
            depths = (dataset.points @ viewmat[:3, :3].T + viewmat[:3, 3])[:, 2]
            bounds = np.percentile(depths[depths > 0], (0.1, 99.9)) * (0.9, 1.1) if (depths > 0).any() else (1.0, 100.0)
            world = np.linalg.inv(np.asarray(viewmat, np.float64))
            last = np.array([[dataset.height], [dataset.width], [K[0, 0]]])
            pose = np.concatenate([world[:3, :3] @ _AXES, world[:3, 3:], last], -1)
            rows[name] = np.concatenate([pose.ravel(), bounds])
    with new_folder(folder) as target:
        write_pictures(dataset, target / "images", target)
        write_lists(dataset, target)
        in_order = sorted(rows, key=lambda name: Path(f"{name}.png"))  # as `by_name` finds the pictures
        np.save(target / POSES_FILE, np.stack([rows[name] for name in in_order]))
        if not dataset.points_are_random:
            clouds.write_ply(target / clouds.CLOUD_FILES[0], dataset.points, dataset.colors)


def _camera(
    source: str, row: Float64[np.ndarray, "17"]
) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, "3 3"], Lens, tuple[int, int]]:
    """World to camera, intrinsics, lens and size."""
    pose = row[:15].reshape(3, 5)
    height, width, focal = pose[:, 4]
    if not (1 <= width < 2**31 and 1 <= height < 2**31 and focal > 0 and 0 < row[15] < row[16]):
        raise UserError(
            f"{source}: size {width}x{height}, focal length {focal}, bounds {row[15]} to {row[16]}; expected "
            "positive numbers and the nearer bound first"
        )
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = rotation(f"{source}: the pose", pose[:, :3] @ _AXES), pose[:, 3]
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return np.linalg.inv(world), K, Lens(), (round(width), round(height))
