"""Videos of a run."""

import contextlib
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from tqdm import tqdm

from l2dgs_jax.cameras.geometry import select_camera
from l2dgs_jax.cameras.paths import space_time_path
from l2dgs_jax.data.images import to_bytes
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runtime.files import replacing
from l2dgs_jax.runtime.prefetch import prefetch

VIDEO_SECONDS = 4
VIDEO_RATE = 24  # frames a second


def write_run_video(run: Run, path: Path) -> None:
    """A short flight through space and time: the estimate of the dark input on the left, well-lit on the right.

    Raises:
        UserError: the file cannot be written.
    """
    cameras = space_time_path(run.dataset.train.cameras, VIDEO_SECONDS * VIDEO_RATE)
    renderer = run.renderer()
    frames = prefetch(lambda i: renderer(select_camera(cameras, i)).images, range(len(cameras.time)))
    outputs = tqdm(frames, total=len(cameras.time), desc="video", unit="frame", dynamic_ncols=True)
    write_video(path, (to_bytes(np.hstack([x.lowlight, x.welllit])) for x in outputs), VIDEO_RATE)


def write_video(path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]], fps: int) -> None:
    """Write an .mp4 whole or not at all; odd sizes are padded by one row or column, as the codec wants even ones.

    Args:
        path: the file.
        frames: RGB frames of one size, at least one.
        fps: frames a second.

    Raises:
        UserError: the file cannot be written, or this build of OpenCV lacks the codec.
    """
    with replacing(path) as temporary, contextlib.ExitStack() as stack:
        writer = None
        for frame in frames:
            height, width = frame.shape[:2]
            if writer is None:
                size = (width + width % 2, height + height % 2)
                writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter_fourcc(*"mp4v"), fps, size)  # type: ignore[attr-defined]
                stack.callback(writer.release)
                if not writer.isOpened():
                    raise UserError(f"{path}: cannot be written; expected an OpenCV with the mp4v codec")
            even = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), "edge")
            writer.write(cv2.cvtColor(even, cv2.COLOR_RGB2BGR))
