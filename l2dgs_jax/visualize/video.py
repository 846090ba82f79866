"""Videos that browsers play: H.264 in .mp4 with PyAV if it is installed, or else VP8 in .webm with OpenCV."""

import contextlib
import errno
import os
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from l2dgs_jax.runtime.files import replacing

Add = Callable[[UInt8[np.ndarray, "H W 3"]], None]

_BT709, _SRGB, _BT601, _LIMITED = 1, 13, 6, 1  # numbers of ITU-T H.273: primaries, transfer, matrix, range


@contextlib.contextmanager
def open_video(stem: Path, size: tuple[int, int], fps: float | int) -> Iterator[Add]:
    """Write a video whole or not at all; yields a function that adds an RGB frame.

    Codecs need even sizes: if a size is odd, the last column or row is repeated.

    Args:
        stem: the file without its suffix; `video_path` returns it with the suffix.
        size: width and height of the frames, pixels.
        fps: frames per second.

    Raises:
        UserError: the file cannot be written, or OpenCV lacks the codec.
    """
    path, (width, height) = video_path(stem), size
    even = width + width % 2, height + height % 2
    encode = _h264 if path.suffix == ".mp4" else _vp8
    with replacing(path) as temporary, encode(temporary, even, fps) as add_even:
        yield lambda frame: add_even(np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), "edge"))


def video_path(stem: Path) -> Path:
    """The file that `open_video` writes."""
    return stem.with_name(stem.name + (".mp4" if _pyav() else ".webm"))


def _pyav() -> Any:
    """PyAV, if it is installed and has the encoder libx264."""
    try:
        import av

        av.Codec("libx264", "w")
    except (ImportError, ValueError):
        return None
    return av


@contextlib.contextmanager
def _h264(path: Path, size: tuple[int, int], fps: float | int) -> Iterator[Add]:
    av = _pyav()
    # "+faststart" puts the index at the front, so that a browser can start before it has the whole file.
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as file:
        stream = file.add_stream("libx264", Fraction(fps).limit_denominator(1001), options={"crf": "18"})
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"  # browsers decode no other
        coding = stream.codec_context
        coding.color_primaries, coding.color_trc, coding.colorspace, coding.color_range = (
            _BT709,
            _SRGB,
            _BT601,
            _LIMITED,
        )
        yield lambda frame: file.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
        file.mux(stream.encode())


@contextlib.contextmanager
def _vp8(path: Path, size: tuple[int, int], fps: float | int) -> Iterator[Add]:
    # VP9 takes four times the processor time for files of 0.6 times the size; OpenCV's wheels cannot write H.264.
    with _silence():
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"VP80"), fps, size)  # type: ignore[attr-defined]
    added = 0

    def add(frame: UInt8[np.ndarray, "H W 3"]) -> None:
        nonlocal added
        writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        added += 1

    try:
        if not writer.isOpened():
            raise OSError(0, "this OpenCV lacks VP8: pip install av")
        yield add
    finally:
        writer.release()
    written = cv2.VideoCapture(str(path))
    complete = sum(iter(written.grab, False)) == added
    written.release()
    if not complete:
        raise OSError(errno.ENOSPC, "frames are missing, the disk may be full")  # OpenCV itself reports nothing


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Suppress standard error, where OpenCV's C code warns that WebM has names instead of tags for codecs."""
    kept = os.dup(2)
    try:
        with open(os.devnull, "w") as nothing:
            os.dup2(nothing.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
