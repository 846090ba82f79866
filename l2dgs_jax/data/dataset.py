"""The one type that every reader returns, and the step from described frames to it."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Float16

from l2dgs_jax.data import images
from l2dgs_jax.errors import UserError
from l2dgs_jax.types import Camera

_T = TypeVar("_T")
_U = TypeVar("_U")


@dataclass(frozen=True)
class Split:
    """Frames of a scene, in memory as NumPy arrays.

    Attributes:
        names: of the frames.
        cameras: stacked float32 arrays; K is that of the stored images and has no skew, the images no distortion.
        images: low-light sRGB values in [0, 1]. Half floats keep what averaging dark 8-bit pixels gains in precision.
        welllit: the same views at normal exposure, sRGB values in [0, 1], if the scene has them.
        masks: True where something moves, if the scene has them.
    """

    names: tuple[str, ...]
    cameras: Camera
    images: Float[np.ndarray, "F H W 3"]
    welllit: Float[np.ndarray, "F H W 3"] | None = None
    masks: Bool[np.ndarray, "F H W"] | None = None


@dataclass(frozen=True)
class Dataset:
    """A scene as the package sees it, whatever layout its files have.

    Attributes:
        name: for messages.
        width: of every image, pixels.
        height: of every image, pixels.
        train: frames to learn from.
        test: held-out frames.
        points: where the scene has surfaces, world units.
        colors: sRGB values in [0, 1] of the points, if known.
    """

    name: str
    width: int
    height: int
    train: Split
    test: Split
    points: Float[np.ndarray, "P 3"]
    colors: Float[np.ndarray, "P 3"] | None = None


class Picture(NamedTuple):
    """A picture file and the factor by which it is already smaller than the camera's full size."""

    path: Path
    scale: int


@dataclass(frozen=True)
class Frame:
    """What a reader knows of a frame before any picture is read.

    Attributes:
        name: of the frame.
        source: the file that describes its camera, for messages.
        viewmat: world to camera, rigid.
        K: intrinsics in pixels of the full size.
        distortion: (k1, k2, p1, p2, k3), see `images.undistort`.
        size: full width and height in pixels.
        time: instant in [0, 1].
        image: the low-light picture.
        welllit: the same view at normal exposure, if there is one.
        mask: bright where something moves, if there is one.
    """

    name: str
    source: Path
    viewmat: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, "5"]
    size: tuple[int, int]
    time: float
    image: Picture
    welllit: Picture | None = None
    mask: Picture | None = None


def assemble(
    name: str,
    train: Sequence[Frame],
    test: Sequence[Frame],
    points: Float[np.ndarray, "P 3"],
    colors: Float[np.ndarray, "P 3"] | None,
    downscale: int,
) -> Dataset:
    """Read the pictures of the frames, undistorted and `downscale` times smaller than the cameras' full size.

    Args:
        name: of the scene.
        train: frames to learn from.
        test: held-out frames.
        points: surface points, world units.
        colors: of the points, in [0, 1].
        downscale: every picture's own scale divides it.

    Raises:
        UserError: a picture is missing, damaged, or of another size than its camera or the other pictures.
    """
    width, height = _common_size([*train, *test])
    if min(width, height) < downscale:
        raise UserError(f"--downscale {downscale}: expected at most {min(width, height)}, the images' shorter side")
    width, height = width // downscale, height // downscale
    read = lambda frames: _read_split(frames, width, height, downscale)
    return Dataset(name, width, height, read(train), read(test), points, colors)


def _common_size(frames: Sequence[Frame]) -> tuple[int, int]:
    """The full size of all frames, after comparing it with every picture's header."""
    first = frames[0]
    for frame in frames:
        if frame.size != first.size:
            raise UserError(
                f"{frame.source}: the image size is {_by(frame.size)}; expected {_by(first.size)} as in {first.source}"
            )
    for kind in ("image", "welllit", "mask"):
        pictures: list[Picture] = [picture for frame in frames if (picture := getattr(frame, kind))]
        for picture, size in zip(pictures, _parallel(lambda p: images.image_size(p.path), pictures), strict=True):
            exact = [full / picture.scale for full in first.size]
            if any(abs(actual - full) >= 1 for actual, full in zip(size, exact, strict=True)):
                wanted = (round(exact[0]), round(exact[1]))
                raise UserError(
                    f"{picture.path}: the picture is {_by(size)}; expected {_by(wanted)} as the cameras say"
                )
    return first.size


def _read_split(frames: Sequence[Frame], width: int, height: int, downscale: int) -> Split:
    """Read the pictures of one split; truth that no frame has is None."""

    def read(frame: Frame, picture: Picture) -> Float16[np.ndarray, "H W 3"]:
        K = images.scale_intrinsics(frame.K, picture.scale)
        image = images.undistort(images.read_image(picture.path), K, frame.distortion)
        small = images.area_average(image, downscale // picture.scale)
        return small[:height, :width].astype(np.float16)

    def read_all(kind: str) -> Float16[np.ndarray, "F H W 3"] | None:
        pictures = [getattr(frame, kind) for frame in frames]
        if None in pictures:
            return None
        return np.stack(_parallel(lambda pair: read(*pair), list(zip(frames, pictures, strict=True))))

    lowlight, masks = read_all("image"), read_all("mask")
    assert lowlight is not None
    return Split(
        names=tuple(frame.name for frame in frames),
        cameras=Camera(
            viewmat=_stack([frame.viewmat for frame in frames]),
            K=_stack([images.scale_intrinsics(images.without_skew(frame.K), downscale) for frame in frames]),
            time=_stack([frame.time for frame in frames]),
        ),
        images=lowlight,
        welllit=read_all("welllit"),
        masks=None if masks is None else masks.mean(-1) > 0.5,
    )


def _parallel(function: Callable[[_T], _U], items: Iterable[_T]) -> list[_U]:
    """Map on threads: decoding and resampling release the interpreter lock."""
    with ThreadPoolExecutor(max_workers=8) as pool:
        return list(pool.map(function, items))


def _stack(values: Sequence[Any]) -> Any:
    """Stacked as float32; `Any` because `Camera` declares jax arrays and these are NumPy's."""
    return np.stack(values).astype(np.float32)


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]} pixels"
