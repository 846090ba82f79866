"""Frames of a video or a folder: measuring their sharpness, selecting some, and writing these unchanged."""

import contextlib
import math
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Shaped, UInt8
from tqdm import tqdm

from l2dgs_jax.data import images
from l2dgs_jax.data.splits import numbers_in
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.files import replacing

SCORED_SIZE = 480  # longer side at which sharpness is measured, pixels


class Candidate(NamedTuple):
    """A frame that could be selected.

    Attributes:
        number: its time: milliseconds into a video, or the number in a picture's name; unique and increasing.
        origin: where it is from: the picture's name, or its position in the video.
        sharpness: comparable only between frames that show about the same.
    """

    number: int
    origin: str
    sharpness: float

    @property
    def name(self) -> str:
        """Name of its picture: the number alone, so that readers of the scene can derive its instant."""
        return f"{self.number:06d}.png"


def scan(source: Path) -> list[Candidate]:
    """All frames of a video, or all pictures of a folder in the order of the numbers in their names.

    Raises:
        UserError: there is nothing to read, a picture is damaged, or pictures differ in size.
    """
    if source.is_dir():
        return _scan_folder(source)
    times, scores = [], []
    with tqdm(desc="decoding", unit="frame", dynamic_ncols=True) as bar:
        for milliseconds, frame in _decode(source):
            times.append(round(milliseconds))
            scores.append(sharpness(frame[..., ::-1].astype(np.float32) / 255))
            bar.update()
    return [Candidate(n, f"frame {i}", s) for i, (n, s) in enumerate(zip(_increasing(times), scores, strict=True))]


def sample(scores: Sequence[float], count: int) -> list[int]:
    """Indices of at most `count` sharp frames that are about evenly spaced.

    The clip is divided into `count` equal parts; from the middle half of each, the sharpest frame is taken.
    """
    total = len(scores)
    if total <= count:
        return list(range(total))
    part = total / count
    reach = max(0.5, part / 4)
    chosen = []
    for i in range(count):
        centre = (i + 0.5) * part - 0.5
        nearby = range(max(0, math.ceil(centre - reach)), min(total - 1, math.floor(centre + reach)) + 1)
        chosen.append(max(nearby, key=lambda j: scores[j]))
    return chosen


def extract(source: Path, candidates: Sequence[Candidate], chosen: Sequence[int], folder: Path) -> None:
    """Write the chosen frames to `folder`, which may already hold some of them from an earlier call.

    PNG files are copied byte by byte; other pictures become upright PNG with the same pixel values, and so do video
    frames as they are decoded, with 8 bits.

    Raises:
        UserError: a frame cannot be read or written.
    """
    missing = {i for i in chosen if not (folder / candidates[i].name).exists()}
    if not missing:
        return
    with tqdm(total=len(missing), desc="frames", unit="frame", dynamic_ncols=True) as bar:
        if source.is_dir():
            for i in sorted(missing):
                _take(source / candidates[i].origin, folder / candidates[i].name)
                bar.update()
            return
        for i, (_, frame) in enumerate(_decode(source)):
            if i in missing:
                images.write_image(folder / candidates[i].name, frame[..., ::-1])
                bar.update()
            if i == max(missing):
                break


def sharpness(image: Float32[np.ndarray, "H W 3"]) -> float:
    """Mean squared Laplacian relative to the squared mean brightness, so that exposure does not matter.

    It is measured on a small, slightly blurred copy: at full size, the noise of a dark frame would look like detail.
    """
    grey = shrink(luma(image), SCORED_SIZE)
    grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
    return float(np.square(cv2.Laplacian(grey, cv2.CV_32F)).mean() / max(float(grey.mean()) ** 2, 1e-8))


def luma(image: Float32[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
    """Luma (Rec. 601) in [0, 1], the grey value that feature matching uses."""
    return image @ np.array([0.299, 0.587, 0.114], np.float32)


def shrink(grey: Shaped[np.ndarray, "H W"], longest: int) -> Shaped[np.ndarray, "h w"]:
    """Reduce a picture whose longer side exceeds `longest`."""
    scale = longest / max(grey.shape)
    return grey if scale >= 1 else cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _increasing(times: Sequence[int]) -> list[int]:
    """The times, one later where a time stamp is repeated; or numbers if the container has no time stamps."""
    order = np.arange(len(times))
    if np.sum(np.diff(times) > 0) < len(times) // 2:
        return order.tolist()
    return (np.maximum.accumulate(times - order) + order).tolist()


def _scan_folder(folder: Path) -> list[Candidate]:
    pictures = (path for path in folder.iterdir() if path.suffix.lower() in images.SUFFIXES and path.is_file())
    paths = sorted(path for path in pictures if not path.name.startswith("."))
    if not paths:
        raise UserError(f"{folder}: holds no pictures; expected frames ({', '.join(images.SUFFIXES)})")
    numbered = sorted(zip(_numbers([path.stem for path in paths]), paths, strict=True))
    first, candidates = numbered[0][1], []
    size = images.read_header(first).size
    for number, path in tqdm(numbered, desc="reading", unit="frame", dynamic_ncols=True):
        found = images.read_header(path).size
        if found != size:
            by = "x".join
            raise UserError(
                f"{path}: the picture is {by(map(str, found))} pixels; expected {by(map(str, size))} as {first.name}"
            )
        candidates.append(Candidate(number, path.name, sharpness(images.read_image(path))))
    return candidates


def _numbers(stems: Sequence[str]) -> list[int]:
    """The numbers in the names, if they differ between all of these, or else their places in alphabetical order."""
    numbers = numbers_in(stems)
    return numbers if len(set(numbers)) == len(stems) else list(range(len(stems)))


def _take(path: Path, target: Path) -> None:
    if path.suffix.lower() == ".png" and images.read_header(path).orientation == 1:
        with replacing(target) as temporary:
            shutil.copyfile(path, temporary)
        return
    values = images.read_image(path)
    exact = np.abs(images.to_bytes(values) / np.float32(255) - values).max() < 1e-6
    images.write_image(target, images.to_bytes(values) if exact else np.rint(values * 65535).astype(np.uint16))


def _decode(path: Path) -> Iterator[tuple[float, UInt8[np.ndarray, "H W 3"]]]:
    """Milliseconds and BGR pixels of every frame, turned upright as the container says."""
    if not path.is_file():
        raise UserError(f"{path}: no such file or folder; expected a video or a folder of frames")
    with contextlib.closing(_Capture(path)) as capture:
        while True:
            decoded, frame = capture.video.read()
            if not decoded:
                return
            yield capture.video.get(cv2.CAP_PROP_POS_MSEC), frame


class _Capture:
    """OpenCV's video reader with a `close` method."""

    def __init__(self, path: Path) -> None:
        self.video: Any = cv2.VideoCapture(str(path))
        if not self.video.isOpened():
            raise UserError(f"{path}: not a video that OpenCV can read; expected a video or a folder of frames")
        self.video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)

    def close(self) -> None:
        self.video.release()
