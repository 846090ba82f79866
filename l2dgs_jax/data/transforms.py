"""The layouts of Blender, D-NeRF (arXiv 2011.13961), instant-ngp and nerfstudio.

    transforms.json, or transforms_{train,test,val}.json     frames, cameras (axes right, up, back) and instants
    the pictures that they name   [images_<k>/<name> beside images/<name>, k times smaller]
    [masks that they name as mask_path, white where pixels count]
    [a point cloud, see `clouds.find`]   [dataset.json]   [metadata.json]   as in the layout of Nerfies

Brackets mark what is optional. Alpha says how much of a pixel the scene covers: pictures are composited over black,
which is also what is rendered where nothing is drawn.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from l2dgs_jax.cameras.geometry import OPENGL_AXES
from l2dgs_jax.data import clouds, splits
from l2dgs_jax.data.assembly import Frame, assemble
from l2dgs_jax.data.dataset import Dataset
from l2dgs_jax.data.images import SUFFIXES, read_header
from l2dgs_jax.data.lens import Lens
from l2dgs_jax.data.parsing import name_list, numbers, read_json, rotation, value
from l2dgs_jax.data.pictures import Picture, copies, is_turned
from l2dgs_jax.data.splits import NO_LISTS, Lists
from l2dgs_jax.data.writing import write_pictures
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.files import new_folder, write_json

Entry = tuple[Path, dict[str, Any], Path]  # the file that lists a frame, the frame's values in it, and its picture

_PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


def recognizes(folder: Path) -> bool:
    """Whether the folder has this layout."""
    return any((folder / f"transforms{part}.json").is_file() for part in ("", "_train"))


def read(folder: Path, downscale: int, held_out: str, frame_memory: float) -> Dataset:
    """Read a scene; without a point cloud, random points fill a box that all cameras look at.

    Args:
        folder: of the scene.
        downscale: integer factor by which images are smaller than full size.
        held_out: see `splits.hold_out`; without lists every eighth frame is held out.
        frame_memory: see `assemble`.

    Raises:
        UserError: a file is missing, malformed or inconsistent.
    """
    entries, own, ply = _entries(folder)
    names = list(entries)
    own = own if own[1] else splits.lists_beside(folder, names)
    train, test, notes = splits.hold_out(str(folder), names, own, held_out, default="8")
    times = _times(folder, entries)
    pictures = _pictures(folder, {name: entries[name][2] for name in [*train, *test]}, downscale)
    frames = {name: _frame(name, *entries[name], times[name], picture) for name, picture in pictures.items()}

    cloud = clouds.find(folder, ply)  # not from sparse/, whose world other programs have moved and scaled
    if random := cloud is None:
        cloud = clouds.in_common_box(np.stack([frame.viewmat for frame in frames.values()]), str(folder)), None
        stand_in = f"{clouds.RANDOM_POINTS} random points where its cameras look stand in for one"
        notes = (*notes, f"{folder} has no point cloud: {stand_in}")
    if any("depth_file_path" in content for _, content, _ in entries.values()):
        notes = (*notes, f"{folder}: 'depth_file_path' is not read; depth belongs into depth/ (docs/data.md)")
    train_frames, test_frames = ([frames[name] for name in part] for part in (train, test))
    return assemble(folder, train_frames, test_frames, *cloud, downscale, frame_memory, notes, random)


def write(dataset: Dataset, folder: Path) -> None:
    """Write a scene in nerfstudio's layout so that `read` gives it back; pictures get 8 bits.

    Raises:
        UserError: some pixels are not valid, which the layout cannot express; or the folder holds files already or
            cannot be written.
    """
    files: dict[str, list[str]] = {"train": [], "val": []}
    frames: dict[str, dict[str, Any]] = {}  # a frame may be held out and trained on
    for part, split in (("train", dataset.train), ("val", dataset.test)):
        if split.valid is not None:
            raise UserError("--to transforms: some pixels of the scene are not valid; expected nerfies, colmap or llff")
        for name, viewmat, K, time in zip(split.names, *split.cameras, strict=True):
            files[part].append(f"images/{name}.png")
            world = np.linalg.inv(np.asarray(viewmat, np.float64)) @ OPENGL_AXES
            intrinsics = dict(zip(("fl_x", "fl_y", "cx", "cy"), map(float, (K[0, 0], K[1, 1], *K[:2, 2])), strict=True))
            entry = {"file_path": files[part][-1], "time": float(time), "transform_matrix": world.tolist()}
            frames[name] = entry | intrinsics
    content = {
        "camera_model": "OPENCV",
        "w": dataset.width,
        "h": dataset.height,
        "train_filenames": files["train"],
        "val_filenames": files["val"],
        "test_filenames": files["val"],
        "frames": sorted(frames.values(), key=lambda frame: frame["file_path"]),
    }
    with new_folder(folder) as target:
        write_pictures(dataset, target / "images", target)
        if not dataset.points_are_random:
            content["ply_file_path"] = clouds.CLOUD_FILES[0]
            clouds.write_ply(target / clouds.CLOUD_FILES[0], dataset.points, dataset.colors)
        write_json(target / "transforms.json", content)


def world_to_camera(source: str, key: str, matrix: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
    """World-to-camera matrix with OpenCV's axes, from a camera-to-world matrix with OpenGL's axes.

    Args:
        source: where the matrix is from, for messages.
        key: its name there.
        matrix: camera to world, rigid.

    Raises:
        UserError: the matrix is not rigid.
    """
    rotation(f"{source}: '{key}'", matrix[:3, :3])
    if not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise UserError(f"{source}: the last row of '{key}' is {matrix[3]}; expected 0 0 0 1")
    return np.linalg.inv(matrix @ OPENGL_AXES)


def _entries(folder: Path) -> tuple[dict[str, Entry], Lists, str | None]:
    """All frames by name, the lists of training and held-out frames, and the point cloud that the file names."""
    single = folder / "transforms.json"
    if single.is_file():
        content = read_json(single, "the frames")
        entries = _listed(single, content)
        parts = [
            next(filter(None, (name_list(single, content, key) for key in keys if key in content)), [])
            for keys in (("train_filenames",), ("test_filenames", "val_filenames"))
        ]
        train, test = ([_name(folder, _picture(single, file)) for file in files] for files in parts)
        unknown = sorted({*train, *test} - entries.keys())
        if unknown:
            raise UserError(f"{single}: lists '{unknown[0]}', which is not among its frames; expected one of them")
        ply = value(single, content, "ply_file_path", str) if content.get("ply_file_path") else None
        train = train or [name for name in entries if name not in test]
        return entries, (train, test) if train and test else NO_LISTS, ply
    lists: list[list[str]] = []
    entries = {}
    held_out = next((part for part in ("test", "val") if (folder / f"transforms_{part}.json").is_file()), None)
    for part in ("train", held_out):
        path = folder / f"transforms_{part}.json"
        found = _listed(path, read_json(path, "the frames")) if part else {}
        for name, (*_, picture) in found.items():
            if name in entries and not entries[name][2].samefile(picture):
                raise UserError(
                    f"{path}: frames {picture} and {entries[name][2]} are both '{name}'; expected names that differ"
                )
        lists.append([name for name in found if name not in entries])  # training frames are not held out as well
        entries = {**entries, **found, **entries}
    return entries, (lists[0], lists[1]), None


def _listed(path: Path, content: dict[str, Any]) -> dict[str, Entry]:
    """The frames that a file lists, in the order of their names; each has the file's common values as well."""
    shared = {key: entry for key, entry in content.items() if key != "frames"}
    entries: dict[str, Entry] = {}
    for i, frame in enumerate(value(path, content, "frames", list)):
        if not isinstance(frame, dict):
            raise UserError(f"{path}: frame {i} is no JSON object; expected file_path and transform_matrix")
        picture = _picture(path, value(f"{path}, frame {i}", frame, "file_path", str))
        name = _name(path.parent, picture)
        if name in entries:
            raise UserError(
                f"{path}: frames {entries[name][2]} and {picture} are both '{name}'; expected names that differ"
            )
        entries[name] = (path, shared | frame, picture)
    return dict(sorted(entries.items()))


def _picture(path: Path, file: str) -> Path:
    """The picture that an entry names, with or without its suffix."""
    named = path.parent / file
    candidates = [named, *(named.with_name(f"{named.name}{suffix}") for suffix in SUFFIXES if named.name)]
    found = next((candidate for candidate in candidates if os.path.isfile(candidate)), None)
    if found is None:
        raise UserError(f"{named}: no such file; expected the picture that {path} names")
    return found


def _name(folder: Path, picture: Path) -> str:
    """A picture's path without its suffix, relative to `images` or to the scene, without `..`."""
    parts = Path(os.path.relpath(picture, folder)).with_suffix("").parts
    within = parts[1:] if parts[0] == "images" else parts
    return "/".join(part for part in within or parts if part != os.pardir)


def _times(folder: Path, entries: dict[str, Entry]) -> dict[str, float]:
    """The frames' own instants, or else those of `splits.instants`."""
    if not any("time" in content for _, content, _ in entries.values()):
        return splits.instants(folder, list(entries))
    sources = [f"{path}, frame '{name}'" for name, (path, *_) in entries.items()]
    contents = [content for _, content, _ in entries.values()]
    times = np.array([float(numbers(*entry, "time", ())) for entry in zip(sources, contents, strict=True)])
    return dict(zip(entries, splits.normalised(times).tolist(), strict=True))


def _pictures(folder: Path, files: dict[str, Path], downscale: int) -> dict[str, Picture]:
    """The frames' own files, or smaller copies of those in `images`."""
    root = folder / "images"
    within = {name: Path(os.path.relpath(file, root)) for name, file in files.items()}
    inside = {name: path.as_posix() for name, path in within.items() if path.parts[0] != os.pardir}
    plain = {name: Picture(file, 1) for name, file in files.items()}
    return plain | dict(zip(inside, copies(folder, root, downscale, inside) if inside else (), strict=True))


def _frame(name: str, path: Path, content: dict[str, Any], file: Path, time: float, picture: Picture) -> Frame:
    source = f"{path}, frame '{name}'"
    viewmat = world_to_camera(source, "transform_matrix", numbers(source, content, "transform_matrix", (4, 4)))
    if "w" in content and "h" in content:
        size = int(numbers(source, content, "w", ())), int(numbers(source, content, "h", ()))
    else:
        size = read_header(file).size
    if min(size) < 1:
        raise UserError(f"{source}: 'w' and 'h' are {size}; expected positive numbers of pixels")
    K, lens = _intrinsics(path, source, content, size)
    mask = Picture(_picture(path, value(source, content, "mask_path", str)), 1) if content.get("mask_path") else None
    upright = is_turned(picture, size)
    return Frame(name, source, viewmat, K, lens, size, time, picture, alpha="coverage", mask=mask, upright=upright)


def _intrinsics(
    path: Path, source: str, content: dict[str, Any], size: tuple[int, int]
) -> tuple[Float64[np.ndarray, "3 3"], Lens]:
    def number(key: str, default: float) -> float:
        return float(numbers(path, content, key, ())) if key in content else default

    def focal(axis: str, length: int) -> float:
        if f"fl_{axis}" not in content and f"camera_angle_{axis}" in content:
            return length / 2 / np.tan(number(f"camera_angle_{axis}", 0.0) / 2)
        return number(f"fl_{axis}", 0.0)

    with np.errstate(all="ignore"):
        fx, fy = focal("x", size[0]), focal("y", size[1])
    fy = fy or fx
    if not (0 < fx < 1e18 and 0 < fy < 1e18):
        raise UserError(f"{source}: has no positive focal length; expected 'fl_x' or 'camera_angle_x'")
    model = content.get("camera_model", "OPENCV")
    if model not in _PERSPECTIVE + _FISHEYE:
        raise UserError(f"{source}: 'camera_model' is {model!r}; expected one of {', '.join(_PERSPECTIVE + _FISHEYE)}")
    K = np.array([[fx, 0, number("cx", size[0] / 2)], [0, fy, number("cy", size[1] / 2)], [0, 0, 1]])
    radial = tuple(number(f"k{i}", 0.0) for i in (1, 2, 3, 4))
    if model in _FISHEYE or content.get("is_fisheye"):
        return K, Lens(radial, fisheye=True)
    return K, Lens(radial, tangential=(number("p1", 0.0), number("p2", 0.0)))
