"""The layout of COLMAP and 3D Gaussian Splatting: a sparse model beside the pictures that it was made from.

    sparse/0/{cameras,images,points3D}.{bin,txt}, or the same in sparse/
    images/<name>, or the pictures in another folder or beside sparse/   [images_<k>/<name>, k times smaller]
    [dataset.json]   [metadata.json]   as in the layout of Nerfies: held-out frames and instants

Brackets mark what is optional. Alpha 0 marks pixels that do not count.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from l2dgs_jax.data import colmap_model, splits
from l2dgs_jax.data.assembly import Frame, assemble
from l2dgs_jax.data.colmap_model import ModelCamera, ModelImage
from l2dgs_jax.data.dataset import Dataset
from l2dgs_jax.data.lens import Lens
from l2dgs_jax.data.pictures import by_name, copies, is_turned
from l2dgs_jax.data.writing import write_lists, write_pictures
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.files import new_folder


def recognizes(folder: Path) -> bool:
    """Whether the folder has this layout."""
    return colmap_model.find(folder) is not None


def read(folder: Path, downscale: int, held_out: str, frame_memory: float) -> Dataset:
    """Read a scene; its world coordinates are the model's.

    Args:
        folder: of the scene.
        downscale: integer factor by which images are smaller than full size.
        held_out: see `splits.hold_out`; without lists every eighth frame is held out.
        frame_memory: see `assemble`.

    Raises:
        UserError: a file is missing, malformed or inconsistent.
    """
    model = colmap_model.find(folder)
    if model is None:
        raise UserError(f"{folder / 'sparse' / '0'}: no such model; expected COLMAP's cameras, images and points3D")
    cameras, images = colmap_model.read_cameras(model), colmap_model.read_images(model)
    points, colors = colmap_model.read_points(model)

    by_stem = {Path(image.name).with_suffix("").as_posix() if image.name else "": image for image in images}
    if len(by_stem) < len(images):
        raise UserError(f"{model}: lists images that differ only in their suffix; expected names that differ before it")
    names = list(by_stem)
    train, test, notes = splits.hold_out(str(model), names, splits.lists_beside(folder, names), held_out, default="8")
    times = splits.instants(folder, names)
    root = _root(folder, names)

    def frames(chosen: list[str]) -> list[Frame]:
        pictures = copies(folder, root, downscale, {name: by_stem[name].name for name in chosen})
        described = []
        for name, picture in zip(chosen, pictures, strict=True):
            image = by_stem[name]
            if image.camera not in cameras:
                raise UserError(f"{model}: '{image.name}' has camera {image.camera}; expected one that the model lists")
            camera = cameras[image.camera]
            K, lens = pinhole_and_lens(camera)
            if not (K[0, 0] > 0 and K[1, 1] > 0):
                raise UserError(f"{model}: camera {image.camera} has no positive focal length; expected one")
            source, size = f"{model}, camera {image.camera}", (camera.width, camera.height)
            upright = is_turned(picture, size)
            described.append(Frame(name, source, image.viewmat, K, lens, size, times[name], picture, upright=upright))
        return described

    others = sorted(path.name for path in (folder / "sparse").iterdir() if path.is_dir() and path != model)
    if others:
        notes = (*notes, f"{model} is used; sparse/ also holds the models {', '.join(others)}")
    return assemble(folder, frames(train), frames(test), points, colors, downscale, frame_memory, notes)


def write(dataset: Dataset, folder: Path) -> None:
    """Write a scene so that `read` gives it back, except that rotations are rounded and pictures get 8 bits.

    Raises:
        UserError: the folder holds files already or cannot be written.
    """
    cameras: dict[ModelCamera, int] = {}
    images: dict[str, ModelImage] = {}  # a frame may be held out and trained on
    for split in (dataset.train, dataset.test):
        for name, viewmat, K in zip(split.names, split.cameras.viewmat, split.cameras.K, strict=True):
            params = tuple(float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
            camera = ModelCamera("PINHOLE", dataset.width, dataset.height, params)
            number = cameras.setdefault(camera, len(cameras) + 1)
            images[name] = ModelImage(f"{name}.png", np.asarray(viewmat, np.float64), number)
    with new_folder(folder) as target:
        write_pictures(dataset, target / "images", target)
        write_lists(dataset, target)
        colmap_model.write_model(
            target / "sparse" / "0", list(cameras), list(images.values()), dataset.points, dataset.colors
        )


def pinhole_and_lens(camera: ModelCamera) -> tuple[Float64[np.ndarray, "3 3"], Lens]:
    """Intrinsics and distortion of any camera model in `colmap_model.MODELS`."""
    params = list(camera.params)
    single = camera.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
    fx, fy, cx, cy, *rest = [params[0], *params] if single else params
    match camera.model, rest:
        case "OPENCV", (k1, k2, p1, p2):
            lens = Lens((k1, k2), tangential=(p1, p2))
        case "FULL_OPENCV", (k1, k2, p1, p2, k3, *divisor):
            lens = Lens((k1, k2, k3), tuple(divisor), (p1, p2))
        case _:  # the other models have radial terms only, in this order
            lens = Lens(tuple(rest), fisheye=camera.model.endswith("FISHEYE"))
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), lens


def _root(folder: Path, names: list[str]) -> Path:
    """The folder that the images' names are relative to: `images`, or the scene's own, or the only one that fits."""
    usual = folder / "images"
    if usual.is_dir() and by_name(usual).keys() & {*names}:
        return usual
    holds_all = lambda other: {*names} <= by_name(other).keys()
    if holds_all(folder):
        return folder
    if usual.is_dir():
        return usual
    fitting = {path.name: path for path in sorted(folder.iterdir()) if path.is_dir() and holds_all(path)}
    is_copy = lambda name: re.sub(r"_\d+$", "", name) in fitting.keys() - {name}
    originals = [path for name, path in fitting.items() if not is_copy(name)]
    if not originals:
        raise UserError(f"{usual}: no such folder; expected the pictures that the model was made from")
    if len(originals) > 1:
        raise UserError(
            f"{folder}: {originals[0].name}/ and {originals[1].name}/ both hold pictures of all images of the model; "
            "expected those that it was made from in images/"
        )
    return originals[0]
