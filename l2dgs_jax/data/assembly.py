"""From frames as a reader describes them to the data set in memory."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float16, Float32, UInt8

from l2dgs_jax.data import images
from l2dgs_jax.data.dataset import Dataset, Original, Split
from l2dgs_jax.data.lens import Lens, scale_intrinsics, seen, undistort, without_skew
from l2dgs_jax.data.pictures import Picture, stored_if_any
from l2dgs_jax.data.stacks import stacked
from l2dgs_jax.errors import UserError
from l2dgs_jax.threads import in_order
from l2dgs_jax.types import Camera

LINEAR_NOTE = "pictures of floating-point values are taken as linear light and converted to sRGB"

# Decoding and resampling release the interpreter lock.
_parallel = partial(in_order, workers=min(os.cpu_count() or 1, 8))


@dataclass(frozen=True)
class Frame:
    """What a reader knows of a frame before any picture is read.

    Attributes:
        name: of the frame.
        source: what describes its camera, for messages.
        viewmat: world to camera, rigid.
        K: intrinsics in pixels of the full size.
        lens: its distortion.
        size: full width and height in pixels.
        time: instant in [0, 1].
        image: the low-light picture.
        alpha: what its alpha means: which pixels count, or how much of each the scene covers before a black
            background.
    """

    name: str
    source: str
    viewmat: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    lens: Lens
    size: tuple[int, int]
    time: float
    image: Picture
    alpha: Literal["validity", "coverage"] = "validity"


def assemble(
    folder: Path,
    train: Sequence[Frame],
    test: Sequence[Frame],
    points: Float[np.ndarray, "P 3"],
    colors: Float[np.ndarray, "P 3"] | None,
    downscale: int,
    frame_memory: float,
    notes: tuple[str, ...] = (),
) -> Dataset:
    """Read the pictures of the frames, undistorted and `downscale` times smaller than the cameras' full size.

    Whatever the layout, `well/<k>x/<name>.png`, `mask/<k>x/<name>.png` and `covisible/<k>x/{train,val}/<name>.png` in
    the scene's folder are the frames' truth and masks.

    Args:
        folder: of the scene.
        train: frames to learn from.
        test: held-out frames.
        points: surface points, world units.
        colors: of the points, in [0, 1].
        downscale: every picture's own scale divides it.
        frame_memory: GiB that pictures and truth may take together; if they take more they lie in temporary files.
        notes: what the reader assumed.

    Raises:
        UserError: a picture is missing, damaged, or of another size than its camera or the other pictures; or a camera
            or point lies beyond what single precision can hold; or there is no room for the temporary files.
    """
    frames = [*train, *test]
    full = _common_size(frames)
    if min(full) < downscale:
        raise UserError(f"--downscale {downscale}: expected at most {min(full)}, the images' shorter side")
    if _check_pictures([frame.image for frame in frames], full):
        notes = (*notes, LINEAR_NOTE)
    width, height = full[0] // downscale, full[1] // downscale
    kinds = 1 + (folder / "well").is_dir()  # masks take a sixth of what pictures take
    in_file = kinds * len(frames) * height * width * 3 * np.dtype(np.float16).itemsize > frame_memory * 2**30
    learned, train_notes = _read_split(folder, "train", train, width, height, downscale, in_file)
    held_out, test_notes = _read_split(folder, "val", test, width, height, downscale, in_file)
    return Dataset(
        name=folder.resolve().name,
        width=width,
        height=height,
        train=learned,
        test=held_out,
        points=_single(points, f"{folder}: a point"),
        colors=colors,
        notes=tuple(dict.fromkeys((*notes, *train_notes, *test_notes))),
    )


def _common_size(frames: Sequence[Frame]) -> tuple[int, int]:
    first = frames[0]
    for frame in frames:
        if frame.size != first.size:
            raise UserError(
                f"{frame.source}: the image size is {_by(frame.size)}; expected {_by(first.size)} as in {first.source}"
            )
    return first.size


def _check_pictures(pictures: Sequence[Picture], full: tuple[int, int]) -> bool:
    """Compare every picture's header with the cameras' full size; whether any picture holds linear light."""
    headers = list(_parallel(lambda picture: images.read_header(picture.path), pictures))
    for picture, header in zip(pictures, headers, strict=True):
        exact = (full[0] / picture.scale, full[1] / picture.scale)
        if any(abs(actual - wanted) >= 1 for actual, wanted in zip(header.size, exact, strict=True)):
            turned = " once turned as its EXIF orientation says" if header.turned else ""
            raise UserError(
                f"{picture.path}: the picture is {_by(header.size)}{turned}; expected "
                f"{_by((round(exact[0]), round(exact[1])))} as the cameras say"
            )
    return any(header.linear for header in headers)


def _read_split(
    folder: Path, part: str, frames: Sequence[Frame], width: int, height: int, downscale: int, in_file: bool
) -> tuple[Split, list[str]]:
    """Read the pictures of one split, with notes; truth and masks that no frame has are None."""
    names = [frame.name for frame in frames]
    notes: list[str] = []

    def fit(frame: Frame, scale: int, image: Float32[np.ndarray, "h w C"]) -> Float32[np.ndarray, "H W C"]:
        return shrink(undistort(image, scale_intrinsics(frame.K, scale), frame.lens), scale)

    def shrink(image: Float32[np.ndarray, "h w C"], scale: int) -> Float32[np.ndarray, "H W C"]:
        return images.area_average(image, downscale // scale)[:height, :width]

    def stack(values: Iterator[np.ndarray], dtype: type, *channels: int) -> np.ndarray:
        return stacked(values, (len(frames), height, width, *channels), dtype, in_file)

    def read_all(root: Path, prefix: str = "", masks: bool = True) -> np.ndarray | None:
        found, note = stored_if_any(root, downscale, [prefix + name for name in names], all_or_none=not masks)
        if note:
            notes.append(note)
        if not found:
            return None
        _check_pictures(found, frames[0].size)

        def read(index: int) -> Float16[np.ndarray, "H W 3"] | Bool[np.ndarray, "H W"]:
            picture = found[index]
            image = fit(frames[index], picture.scale, images.read_image(picture.path)).astype(np.float16)
            return image.mean(-1) > 0.5 if masks else image

        return stack(_parallel(read, range(len(frames))), *((bool,) if masks else (np.float16, 3)))

    marked: dict[int, UInt8[np.ndarray, " B"]] = {}  # of the frames whose pixels do not all count, which do, as bits

    def read_frame(index: int) -> Float16[np.ndarray, "H W 3"]:
        frame = frames[index]
        scale, alpha = frame.image.scale, None
        if frame.alpha == "coverage":
            image = images.read_over_black(frame.image.path)
        else:
            image, alpha = images.read_image_and_alpha(frame.image.path)
        inside = seen((image.shape[1], image.shape[0]), scale_intrinsics(frame.K, scale), frame.lens)
        # A pixel counts if all that it was made from does.
        counts = all_count
        if inside is not None:
            counts = shrink(inside[..., None].astype(np.float32), scale)[..., 0] > 0.999
        if alpha is not None:
            counts = counts & (fit(frame, scale, (alpha > 0.5).astype(np.float32))[..., 0] > 0.999)
        if not counts.all():
            marked[index] = np.packbits(counts)
        return fit(frame, scale, image).astype(np.float16)

    def counting(index: int) -> Bool[np.ndarray, "H W"]:
        bits = marked.get(index, every_bit)
        return np.unpackbits(bits, count=height * width).reshape(height, width).astype(bool)

    all_count = np.ones((height, width), bool)
    every_bit = np.packbits(all_count)
    lowlight = stack(_parallel(read_frame, range(len(frames))), np.float16, 3)
    K = [scale_intrinsics(without_skew(frame.K), downscale) for frame in frames]
    split = Split(
        names=tuple(names),
        cameras=Camera(
            viewmat=_singles([frame.viewmat for frame in frames], frames),
            K=_singles(K, frames),
            time=_singles([np.array(frame.time) for frame in frames], frames),
        ),
        images=lowlight,
        welllit=read_all(folder / "well", masks=False),
        masks=read_all(folder / "mask"),
        valid=stack(map(counting, range(len(frames))), bool) if marked else None,
        covisible=read_all(folder / "covisible", f"{part}/"),
        originals=tuple(Original(frame.size, frame.K, frame.lens) for frame in frames),
    )
    return split, notes


def _singles(values: Sequence[np.ndarray], frames: Sequence[Frame]) -> Any:
    """Stacked as float32; `Any` because `Camera` declares jax arrays and these are NumPy's."""
    return np.stack([_single(x, f"{frame.source}: the camera") for x, frame in zip(values, frames, strict=True)])


def _single(values: Float[np.ndarray, "*S"], what: str) -> Float32[np.ndarray, "*S"]:
    if not (np.abs(values) < 1e18).all():  # squares must fit as well
        raise UserError(f"{what} holds values beyond 1e18 or not finite; expected a scene of moderate size")
    return values.astype(np.float32)


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]} pixels"
