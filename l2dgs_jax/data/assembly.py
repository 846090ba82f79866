"""From the frames that a reader describes to the data set in memory."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float16, Float32, UInt8

from l2dgs_jax.cameras.geometry import project_points
from l2dgs_jax.data import depth_maps, images
from l2dgs_jax.data.dataset import Dataset, Original, Split
from l2dgs_jax.data.lens import Lens, scale_intrinsics, seen, undistort, without_skew
from l2dgs_jax.data.pictures import Picture, stored_if_any
from l2dgs_jax.data.stacks import stacked
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera

MAX_ROUNDING = 0.5  # pixels by which single precision may move the image of a point
INVERTED_BELOW = -0.3  # correlation of given depth and depth of the points: below it, the given one is inverse depth
LINEAR_NOTE = "pictures of floating-point values are taken as linear light and converted to sRGB"

# Threads help because decoding and resampling release Python's global interpreter lock.
_parallel = partial(prefetch, workers=min(os.cpu_count() or 1, 8))


@dataclass(frozen=True)
class Frame:
    """What a reader knows of a frame before any picture is read.

    Attributes:
        name: of the frame.
        source: the file, or part of it, that describes its camera, for messages.
        viewmat: rigid world-to-camera matrix.
        K: intrinsics in pixels of the full size.
        lens: its distortion.
        size: full width and height in pixels.
        time: instant in [0, 1].
        image: the low-light picture.
        alpha: meaning of its alpha channel: which pixels count ("validity"), or how much of each pixel the scene covers
            in front of a black background ("coverage").
        upright: whether the picture is turned as its EXIF orientation says; otherwise the camera is that of its stored
            rows and columns.
        mask: a picture that is white where pixels count, if there is one.
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
    upright: bool = True
    mask: Picture | None = None


def assemble(
    folder: Path,
    train: Sequence[Frame],
    test: Sequence[Frame],
    points: Float[np.ndarray, "P 3"],
    colors: Float[np.ndarray, "P 3"] | None,
    downscale: int,
    frame_memory: float,
    notes: tuple[str, ...] = (),
    points_are_random: bool = False,
) -> Dataset:
    """Read the pictures of the frames, undistorted and `downscale` times smaller than the cameras' full size.

    In every layout, `well/<k>x/<name>.png`, `mask/<k>x/<name>.png` and `covisible/<k>x/{train,val}/<name>.png` in the
    scene's folder are the frames' ground truth and masks, and `depth/` or `disparity/` (depth_maps.py) their depth.

    Args:
        folder: of the scene.
        train: frames to learn from.
        test: held-out frames.
        points: surface points, world units.
        colors: of the points, in [0, 1].
        downscale: a multiple of every picture's own scale.
        frame_memory: GiB for pictures, ground truth and depth together; if they take more, they go to temporary files.
        notes: assumptions of the reader.
        points_are_random: whether the points only stand in for a cloud that is missing.

    Raises:
        UserError: a picture is missing, damaged, or of another size than its camera or the other pictures; or cameras
            or points have values too large for single precision; or depth and points contradict each other; or there
            is no room for the temporary files.
    """
    frames = [*train, *test]
    full = _common_size(frames)
    if min(full) < downscale:
        raise UserError(f"--downscale {downscale}: expected at most {min(full)}, the images' shorter side")
    if _check_pictures([frame.image for frame in frames], frames):
        notes = (*notes, LINEAR_NOTE)
    masked = [frame for frame in frames if frame.mask]
    _check_pictures([frame.mask for frame in masked if frame.mask], masked)
    _check_precision(folder, frames, points)
    width, height = full[0] // downscale, full[1] // downscale
    # Bytes per pixel; masks, which take a sixth of what pictures take, are not counted.
    size = 6 * (1 + (folder / "well").is_dir()) + 4 * any((folder / kind).is_dir() for kind in depth_maps.FOLDERS)
    in_file = size * len(frames) * height * width > frame_memory * 2**30
    learned, train_notes = _SplitReader(folder, "train", train, width, height, downscale, in_file).read()
    if learned.depths is not None and depth_maps.agreement(learned.depths, learned.cameras, points) < INVERTED_BELOW:
        raise UserError(
            f"{folder}: its depth falls where its points are farther away; expected distances in depth/, and inverse "
            "distances in disparity/"
        )
    held_out, test_notes = _SplitReader(folder, "val", test, width, height, downscale, in_file).read()
    for kind, found in (("well", [learned.welllit, held_out.welllit]), ("mask", [learned.masks, held_out.masks])):
        mentioned = any(note.startswith(f"{kind}/") for note in (*train_notes, *test_notes))
        if (folder / kind).is_dir() and all(x is None for x in found) and not mentioned:
            example = f"{kind}/1x/{frames[0].name}.png"
            notes = (*notes, f"{kind}/ has no picture that is called like a frame, such as {example}: not used")
    return Dataset(
        name=folder.resolve().name,
        width=width,
        height=height,
        train=learned,
        test=held_out,
        points=_single(points, f"{folder}: a point"),
        colors=colors,
        points_are_random=points_are_random,
        notes=tuple(dict.fromkeys((*notes, *train_notes, *test_notes))),
    )


def _check_precision(folder: Path, frames: Sequence[Frame], points: Float[np.ndarray, "P 3"]) -> None:
    """Check that rounding to single precision leaves points in their places in the images, as it may far from 0."""
    sample = points[:: len(points) // 1000 + 1]
    rounded = _single(sample, f"{folder}: a point").astype(float)
    for frame in frames[:: len(frames) // 16 + 1]:
        viewmat = _single(frame.viewmat, f"{frame.source}: the camera").astype(float)
        exact, depth = project_points(sample, frame.viewmat, frame.K)
        shifts = np.linalg.norm(project_points(rounded, viewmat, frame.K)[0] - exact, axis=-1)[depth > 0]
        shift = np.median(np.nan_to_num(shifts, nan=np.inf)) if len(shifts) else 0.0
        if shift > MAX_ROUNDING:
            raise UserError(
                f"{folder}: its coordinates, of up to {np.abs(sample).max():.0e}, are too large for single precision, "
                f"which moves points by {shift:.1f} pixels; expected an origin near the scene: subtract the same "
                "offset from points and camera centres"
            )


def _common_size(frames: Sequence[Frame]) -> tuple[int, int]:
    first = frames[0]
    for frame in frames:
        if frame.size != first.size:
            raise UserError(
                f"{frame.source}: the image size is {_by(frame.size)}; expected {_by(first.size)} as in {first.source}"
            )
    return first.size


def _check_pictures(pictures: Sequence[Picture], frames: Sequence[Frame]) -> bool:
    """Check the sizes of pictures of the frames against their cameras'; returns whether any holds linear light."""
    headers = list(_parallel(lambda picture: images.read_header(picture.path), pictures))
    for picture, header, frame in zip(pictures, headers, frames, strict=True):
        swapped = header.orientation >= 5
        size = header.size if frame.upright or not swapped else header.size[::-1]
        turned = "once turned" if frame.upright else "without being turned"
        _check_size(picture, size, frame.size, f" {turned} as its EXIF orientation says" if swapped else "")
    return any(header.linear for header in headers)


def _check_size(picture: Picture, size: tuple[int, int], full: tuple[int, int], why: str = "") -> None:
    exact = (full[0] / picture.scale, full[1] / picture.scale)
    if any(abs(actual - wanted) >= 1 for actual, wanted in zip(size, exact, strict=True)):
        raise UserError(
            f"{picture.path}: the picture is {_by(size)}{why}; expected "
            f"{_by((round(exact[0]), round(exact[1])))} as the cameras say"
        )


@dataclass(frozen=True)
class _SplitReader:
    """Reads everything on disk that belongs to the frames of one split, undistorted and at one size.

    Attributes:
        folder: of the scene.
        part: "train" or "val".
        frames: of the split.
        width: of the images to return, pixels.
        height: of the images to return, pixels.
        downscale: factor by which they are smaller than full size.
        in_file: whether stacks of frames go to temporary files.
    """

    folder: Path
    part: str
    frames: Sequence[Frame]
    width: int
    height: int
    downscale: int
    in_file: bool

    def read(self) -> tuple[Split, list[str]]:
        """The split, and notes; ground truth, masks and depth are None if they are missing."""
        lowlight, valid = self._lowlight()
        welllit, well_note = self._truth("well", as_mask=False)
        masks, mask_note = self._truth("mask", as_mask=True)
        covisible, covisible_note = self._truth("covisible", as_mask=True, prefix=f"{self.part}/")
        depths, depth_notes = self._depths()
        K = [scale_intrinsics(without_skew(frame.K), self.downscale) for frame in self.frames]
        split = Split(
            names=tuple(frame.name for frame in self.frames),
            cameras=Camera(
                viewmat=_singles([frame.viewmat for frame in self.frames], self.frames),
                K=_singles(K, self.frames),
                time=_singles([np.array(frame.time) for frame in self.frames], self.frames),
            ),
            images=lowlight,
            welllit=welllit,
            masks=masks,
            valid=valid,
            covisible=covisible,
            depths=depths,
            originals=tuple(Original(frame.size, frame.K, frame.lens) for frame in self.frames),
        )
        notes = [note for note in (well_note, mask_note, covisible_note) if note]
        return split, notes + depth_notes if self.part == "train" else notes  # depth is only learned from

    def _lowlight(self) -> tuple[Float16[np.ndarray, "F H W 3"], Bool[np.ndarray, "F H W"] | None]:
        """The low-light images, and which of their pixels count; None if all do."""
        # Until all frames are read, masks are kept as bits, and only for frames with pixels that do not count.
        partly: dict[int, UInt8[np.ndarray, " B"]] = {}

        def read_one(index: int) -> Float16[np.ndarray, "H W 3"]:
            image, counts = self._read_frame(self.frames[index])
            if not counts.all():
                partly[index] = np.packbits(counts)
            return image

        lowlight = self._stack(_parallel(read_one, range(len(self.frames))), np.float16, 3)
        if not partly:
            return lowlight, None
        size = self.height * self.width
        every_bit = np.packbits(np.ones(size, bool))
        bits = (partly.get(index, every_bit) for index in range(len(self.frames)))
        masks = (np.unpackbits(b, count=size).reshape(self.height, self.width).astype(bool) for b in bits)
        return lowlight, self._stack(masks, bool)

    def _read_frame(self, frame: Frame) -> tuple[Float16[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
        """A low-light image, and which of its pixels count."""
        scale, alpha = frame.image.scale, None
        if frame.alpha == "coverage":
            image = images.read_over_black(frame.image.path, frame.upright)
        else:
            image, alpha = images.read_image_and_alpha(frame.image.path, frame.upright)
        counts = np.ones((self.height, self.width), bool)
        # A pixel counts if everything that it was interpolated from does.
        inside = seen((image.shape[1], image.shape[0]), scale_intrinsics(frame.K, scale), frame.lens)
        if inside is not None:
            counts = counts & (self._shrink(inside[..., None].astype(np.float32), scale)[..., 0] > 0.999)
        if alpha is not None:
            counts = counts & (self._fit(frame, (alpha > 0.5).astype(np.float32), scale)[..., 0] > 0.999)
        if frame.mask:
            white = (images.read_image(frame.mask.path, frame.upright)[..., :1] > 0.5).astype(np.float32)
            counts = counts & (self._fit(frame, white, frame.mask.scale)[..., 0] > 0.999)
        return self._fit(frame, image, scale).astype(np.float16), counts

    def _truth(self, kind: str, as_mask: bool, prefix: str = "") -> tuple[Any, str]:
        """The pictures in a folder such as `well/`, as images or as masks, and a note if they cannot be used."""
        names = [prefix + frame.name for frame in self.frames]
        found, note = stored_if_any(self.folder / kind, self.downscale, names, all_or_none=not as_mask)
        if not found:
            return None, note
        _check_pictures(found, self.frames)

        def read_one(index: int) -> Float16[np.ndarray, "H W 3"] | Bool[np.ndarray, "H W"]:
            picture, frame = found[index], self.frames[index]
            read = images.read_over_black if frame.alpha == "coverage" else images.read_image
            image = self._fit(frame, read(picture.path, frame.upright), picture.scale).astype(np.float16)
            return image.mean(-1) > 0.5 if as_mask else image

        read_all = _parallel(read_one, range(len(self.frames)))
        return self._stack(read_all, bool) if as_mask else self._stack(read_all, np.float16, 3), note

    def _depths(self) -> tuple[Float32[np.ndarray, "F H W"] | None, list[str]]:
        """Depth of the frames, 0 where unknown (None if no frame has any), and notes."""
        found, inverse, notes = depth_maps.find(self.folder, self.downscale, [frame.name for frame in self.frames])
        if not found:
            return None, notes
        read_all = _parallel(lambda index: self._depth(self.frames[index], found[index], inverse), range(len(found)))
        return self._stack(read_all, np.float32), notes

    def _depth(self, frame: Frame, file: Picture | None, inverse: bool) -> Float32[np.ndarray, "H W"]:
        """Depth of a frame; a pixel has the inverse of the mean inverse depth of the known samples that it covers."""
        if file is None:
            return np.zeros((self.height, self.width), np.float32)
        disparity = depth_maps.read(file.path, inverse)
        size = (disparity.shape[1], disparity.shape[0])
        _check_size(file, size, frame.size)
        K = scale_intrinsics(frame.K, file.scale)
        straight, inside = undistort(disparity[..., None], K, frame.lens, nearest=True), seen(size, K, frame.lens)
        known = straight > 0 if inside is None else (straight > 0) & inside[..., None]
        total, share = np.moveaxis(self._shrink(np.dstack([straight * known, known]), file.scale), -1, 0)
        return np.divide(share, total, out=np.zeros_like(share), where=share > 0)

    def _fit(self, frame: Frame, image: Float32[np.ndarray, "h w C"], scale: int) -> Float32[np.ndarray, "H W C"]:
        """A picture that is already `scale` times smaller, undistorted and shrunk to the final size."""
        return self._shrink(undistort(image, scale_intrinsics(frame.K, scale), frame.lens), scale)

    def _shrink(self, image: Float32[np.ndarray, "h w C"], scale: int) -> Float32[np.ndarray, "H W C"]:
        return images.area_average(image, self.downscale // scale)[: self.height, : self.width]

    def _stack(self, values: Iterator[np.ndarray], dtype: type, *channels: int) -> np.ndarray:
        return stacked(values, (len(self.frames), self.height, self.width, *channels), dtype, self.in_file)


def _singles(values: Sequence[np.ndarray], frames: Sequence[Frame]) -> Any:
    """Stacked as float32; `Any` because `Camera` declares jax arrays and these are NumPy's."""
    return np.stack([_single(x, f"{frame.source}: the camera") for x, frame in zip(values, frames, strict=True)])


def _single(values: Float[np.ndarray, "*S"], what: str) -> Float32[np.ndarray, "*S"]:
    if not (np.abs(values) < 1e18).all():  # their squares must fit into single precision too
        raise UserError(f"{what} holds values beyond 1e18 or not finite; expected a scene of moderate size")
    return values.astype(np.float32)


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]} pixels"
