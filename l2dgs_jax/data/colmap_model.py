"""COLMAP's sparse models (cameras, images, points3D), binary and text: https://colmap.github.io/format.html."""

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.spatial.transform import Rotation

from l2dgs_jax.errors import UserError

# COLMAP's number of each camera model, and its number of parameters.
MODELS = {
    "SIMPLE_PINHOLE": (0, 3),
    "PINHOLE": (1, 4),
    "SIMPLE_RADIAL": (2, 4),
    "RADIAL": (3, 5),
    "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8),
    "FULL_OPENCV": (6, 12),
    "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5),
}
_BY_NUMBER = {number: (name, count) for name, (number, count) in MODELS.items()}
_KINDS = ("cameras", "images", "points3D")


class ModelCamera(NamedTuple):
    """A camera: its model, its size in pixels, and the parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ModelImage(NamedTuple):
    """A registered image.

    Attributes:
        name: its file, relative to the folder of images.
        viewmat: rigid world-to-camera matrix, OpenCV axes.
        camera: identifier of its camera.
    """

    name: str
    viewmat: Float64[np.ndarray, "4 4"]
    camera: int


def find(folder: Path) -> Path | None:
    """The folder of the scene's model, `sparse/0` or `sparse`, if it has one."""
    for candidate in (folder / "sparse" / "0", folder / "sparse"):
        if any((candidate / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
            return candidate
    return None


def read_cameras(folder: Path) -> dict[int, ModelCamera]:
    """The model's cameras by identifier.

    Raises:
        UserError: their file is missing, damaged, or has a camera model that is not supported.
    """
    path = _file(folder, "cameras")
    cameras = {}
    for number, model, width, height, params in _binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path):
        if not (0 < width < 2**31 and 0 < height < 2**31 and np.isfinite(params).all()):
            raise UserError(f"{path}: camera {number} has no valid size or parameters; expected positive, finite ones")
        cameras[number] = ModelCamera(model, width, height, params)
    return cameras


def read_images(folder: Path) -> list[ModelImage]:
    """The registered images, sorted by name.

    Raises:
        UserError: their file is missing or damaged, or a pose is not a unit quaternion and a translation.
    """
    path = _file(folder, "images")
    images = []
    for name, pose, camera in _binary_images(path) if path.suffix == ".bin" else _text_images(path):
        quat, translation = np.array(pose[:4]), np.array(pose[4:])
        if not (np.isfinite(pose).all() and 0.9 < np.abs(quat).sum() < 2.1):
            raise UserError(f"{path}: the pose of '{name}' is {pose}; expected a unit quaternion and a translation")
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix(), translation
        images.append(ModelImage(name, viewmat, camera))
    return sorted(images, key=lambda image: image.name)


def read_points(folder: Path) -> tuple[Float64[np.ndarray, "P 3"], Float32[np.ndarray, "P 3"] | None]:
    """The model's points and their sRGB colours in [0, 1]; None if all are black, as COLMAP leaves uncoloured points.

    Raises:
        UserError: their file is missing or damaged, or holds none.
    """
    path = _file(folder, "points3D")
    rows = list(_binary_points(path) if path.suffix == ".bin" else _text_points(path))
    if not rows:
        raise UserError(f"{path}: holds no points; expected the sparse cloud of a reconstruction")
    points, colors = np.array([row[:3] for row in rows]), np.array([row[3:] for row in rows])
    if not np.isfinite(points).all() or colors.min() < 0 or colors.max() > 255:
        raise UserError(f"{path}: holds points or colours out of range; expected finite points and colours in 0-255")
    return points, (colors / 255).astype(np.float32) if colors.any() else None


def write_model(
    folder: Path,
    cameras: Sequence[ModelCamera],
    images: Sequence[ModelImage],
    points: Float[np.ndarray, "P 3"],
    colors: Float[np.ndarray, "P 3"] | None,
) -> None:
    """Write a binary model, without the images' observations of the points; cameras are numbered from 1."""
    folder.mkdir(parents=True)
    with open(folder / "cameras.bin", "wb") as file:
        file.write(struct.pack("<Q", len(cameras)))
        for i, (model, width, height, params) in enumerate(cameras):
            number, count = MODELS[model]
            file.write(struct.pack(f"<IiQQ{count}d", i + 1, number, width, height, *params))
    with open(folder / "images.bin", "wb") as file:
        file.write(struct.pack("<Q", len(images)))
        for i, (name, viewmat, camera) in enumerate(images):
            quat = Rotation.from_matrix(viewmat[:3, :3]).as_quat()[[3, 0, 1, 2]]
            file.write(struct.pack("<I7dI", i + 1, *quat, *viewmat[:3, 3], camera))
            file.write(name.encode() + b"\0" + struct.pack("<Q", 0))
    paint = np.zeros(points.shape, np.uint8) if colors is None else np.rint(255 * colors).astype(np.uint8)
    with open(folder / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", len(points)))
        for i, (point, color) in enumerate(zip(points, paint, strict=True)):
            file.write(struct.pack("<Q3d3BdQ", i + 1, *point, *color, 0.0, 0))


def _file(folder: Path, kind: str) -> Path:
    for suffix in (".bin", ".txt"):
        if (folder / f"{kind}{suffix}").is_file():
            return folder / f"{kind}{suffix}"
    wanted = " and ".join(f"{kind}.bin" for kind in _KINDS)
    raise UserError(f"{folder / kind}.bin: no such file; expected {wanted}, or the same as .txt")


class _Records:
    """A binary file, read front to back."""

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, form: str) -> tuple:
        try:
            values = struct.unpack_from(f"<{form}", self.data, self.at)
        except struct.error:
            raise self.truncated() from None
        self.at += struct.calcsize(f"<{form}")
        return values

    def skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self.data):
            raise self.truncated()

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise self.truncated()
        name, self.at = self.data[self.at : end], end + 1
        try:
            return name.decode()
        except UnicodeDecodeError:
            raise UserError(f"{self.path}: the name {name!r} is not UTF-8; expected names in UTF-8") from None

    def end(self) -> None:
        if self.at != len(self.data):
            rest = len(self.data) - self.at
            raise UserError(f"{self.path}: {rest} bytes follow its last record; expected a COLMAP file and no more")

    def truncated(self) -> UserError:
        return UserError(f"{self.path}: ends within a record (truncated or damaged); expected a whole COLMAP file")


def _binary_cameras(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    file = _Records(path)
    for _ in range(file.take("Q")[0]):
        identifier, number, width, height = file.take("IiQQ")
        model, count = _BY_NUMBER.get(number, ("", 0))
        if not model:
            raise _unsupported(path, f"number {number}")
        yield identifier, model, width, height, file.take(f"{count}d")
    file.end()


def _binary_images(path: Path) -> Iterator[tuple[str, tuple[float, ...], int]]:
    file = _Records(path)
    for _ in range(file.take("Q")[0]):
        _, *pose, camera = file.take("I7dI")
        name = file.text()
        file.skip(24 * file.take("Q")[0])  # observations: x, y and the point's identifier
        yield name, tuple(pose), camera
    file.end()


def _binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    file = _Records(path)
    for _ in range(file.take("Q")[0]):
        _, *row, _, observations = file.take("Q3d3BdQ")
        file.skip(8 * observations)
        yield tuple(row)
    file.end()


def _text_cameras(path: Path) -> Iterator[tuple[int, str, int, int, tuple[float, ...]]]:
    for line in _lines(path):
        words = line.split()
        model = words[1] if len(words) > 1 else ""
        if model not in MODELS:
            raise _unsupported(path, model or "''")
        identifier, width, height, *params = _parsed(path, line, [words[0], *words[2:]], (int, int, int, float))
        if len(params) != MODELS[model][1]:
            raise UserError(f"{path}: '{line}' has {len(params)} parameters; expected {MODELS[model][1]} for {model}")
        yield int(identifier), model, int(width), int(height), tuple(params)


def _text_images(path: Path) -> Iterator[tuple[str, tuple[float, ...], int]]:
    lines = iter(_lines(path, keep_empty=True))
    for line in lines:
        if not line:
            continue
        words = line.split(maxsplit=9)
        if len(words) < 10:
            raise UserError(f"{path}: '{line[:80]}' is no image; expected number, pose, camera and name")
        *pose, camera = _parsed(path, line, words[1:9], (float,) * 7 + (int,))
        next(lines, None)  # observations, possibly none
        yield words[9], tuple(pose), int(camera)


def _text_points(path: Path) -> Iterator[tuple[float, ...]]:
    for line in _lines(path):
        words = line.split(maxsplit=7)
        if len(words) < 7:
            raise UserError(f"{path}: '{line[:80]}' is no point; expected number, X Y Z, R G B, error, track")
        yield tuple(_parsed(path, line, words[1:7], (float, float, float, int, int, int)))


def _lines(path: Path, keep_empty: bool = False) -> list[str]:
    try:
        lines = [line.strip() for line in path.read_text("utf-8").splitlines()]
    except UnicodeDecodeError:
        raise UserError(f"{path}: is no text in UTF-8; expected a COLMAP text file") from None
    return [line for line in lines if not line.startswith("#") and (line or keep_empty)]


def _parsed(path: Path, line: str, words: Sequence[str], kinds: Sequence[type]) -> list[Any]:
    """The words converted to numbers of these types; the last type is also that of all further words."""
    kinds = [*kinds[:-1], *[kinds[-1]] * (len(words) - len(kinds) + 1)]
    try:
        return [kind(word) for kind, word in zip(kinds, words, strict=True)]
    except ValueError:
        raise UserError(f"{path}: '{line[:80]}' holds something else than numbers; expected COLMAP's format") from None


def _unsupported(path: Path, model: str) -> UserError:
    return UserError(
        f"{path}: the camera model {model} is not supported; expected one of {', '.join(MODELS)} "
        "(colmap image_undistorter converts others to PINHOLE)"
    )
