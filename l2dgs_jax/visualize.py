"""Pictures and videos of a run: contact sheet, a path through space and time, and the files they go to."""

import contextlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from l2dgs_jax.data.images import to_bytes
from l2dgs_jax.errors import UserError
from l2dgs_jax.files import replacing
from l2dgs_jax.runs import Run
from l2dgs_jax.threads import in_order
from l2dgs_jax.types import Camera, RenderOutput

COLUMNS = ("input", "re-lit low light", "well-lit", "truth", "L", "R", "B1", "B2", "depth")
CELL_WIDTHS = (160, 400)  # pixels that a picture in the contact sheet is at least and at most wide
STRIP = 22  # height of a line of text, pixels
GAP = 4  # pixels between pictures
VIDEO_SECONDS = 4
VIDEO_RATE = 24  # frames a second


def contact_sheet(run: Run, rows: int = 4) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures of a few instants, one row each, in the columns of `COLUMNS`; the truth only where there is one.

    L and R are shown as they are. B1, B2 and depth are coloured (viridis) from their 2nd to their 98th percentile over
    all rows, the range that their heading states.

    Args:
        run: the run.
        rows: how many views, spread over time; held-out views if the scene has some.
    """
    dataset = run.dataset
    held_out = len(dataset.test.names) > 0
    split = dataset.test if held_out else dataset.train
    in_time = np.argsort(split.cameras.time, kind="stable")
    chosen = in_time[np.unique(np.linspace(0, len(in_time) - 1, rows).round().astype(int))].tolist()
    renderer = run.renderer()
    outputs = [jax.device_get(renderer(view(split.cameras, i))) for i in chosen]

    exponents = np.stack([output.images.attenuation for output in outputs])
    depths = np.stack([expected_depth(output) for output in outputs])
    coloured = {"B1": exponents[..., 0], "B2": exponents[..., 1], "depth": depths}
    ranges = {name: np.percentile(values, (2, 98)) for name, values in coloured.items()}
    columns = [name for name in COLUMNS if name != "truth" or split.welllit is not None]
    headings = [f"{name} {ranges[name][0]:.4g}-{ranges[name][1]:.4g}" if name in ranges else name for name in columns]

    lines = []
    kind = "held out" if held_out else "trained on"
    for row, i in enumerate(chosen):
        images = outputs[row].images
        pictures = {
            "input": to_bytes(split.images[i]),
            "re-lit low light": to_bytes(images.lowlight),
            "well-lit": to_bytes(images.welllit),
            "L": to_bytes(np.repeat(images.illumination[..., None], 3, axis=-1)),
            "R": to_bytes(images.reflectance),
        } | {name: viridis(values[row], *ranges[name]) for name, values in coloured.items()}
        if split.welllit is not None:
            pictures["truth"] = to_bytes(split.welllit[i])
        caption = f"{split.names[i]}, time {split.cameras.time[i]:.2f}, {kind}"
        lines.append((caption, [pictures[name] for name in columns]))
    return sheet(headings, lines)


def sheet(
    headings: Sequence[str], rows: Sequence[tuple[str, Sequence[UInt8[np.ndarray, "h w 3"]]]]
) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures of one size in rows under headings, each row below its caption."""
    lines = []
    for caption, pictures in rows:
        cells = np.hstack([np.pad(cell(picture), ((0, GAP), (0, GAP), (0, 0))) for picture in pictures])
        lines += [text_strip(caption, cells.shape[1]), cells]
    header = np.hstack([text_strip(heading, lines[1].shape[1] // len(headings)) for heading in headings])
    return np.vstack([header, *lines])


def video(run: Run, path: Path) -> None:
    """A short flight through space and time: the estimate of the dark input on the left, well-lit on the right.

    Raises:
        UserError: the file cannot be written.
    """
    cameras = space_time_path(run.dataset.train.cameras, VIDEO_SECONDS * VIDEO_RATE)
    renderer = run.renderer()
    frames = in_order(lambda i: renderer(view(cameras, i)).images, range(len(cameras.time)))
    outputs = tqdm(frames, total=len(cameras.time), desc="video", unit="frame", dynamic_ncols=True)
    write_video(path, (to_bytes(np.hstack([x.lowlight, x.welllit])) for x in outputs), VIDEO_RATE)


def space_time_path(cameras: Camera, frames: int) -> Camera:
    """A smooth path along the trained views: a quarter of it at the first instant, then time runs from 0 to 1.

    The pose at an instant is the Gaussian-weighted mean of the views around it, plus a gentle sway within the image
    plane. Where the views jump about from frame to frame, their mean would be no place to stand: the most central
    view stands for all of them.

    Args:
        cameras: F trained views in any order.
        frames: how many cameras to return.

    Returns:
        The path, as `frames` cameras of NumPy arrays of the type of `cameras`.
    """
    times = np.asarray(cameras.time, np.float64)
    rotations = np.asarray(cameras.viewmat[:, :3, :3], np.float64)
    centres = -np.einsum("fji,fj->fi", rotations, cameras.viewmat[:, :3, 3])
    intrinsics = np.asarray(cameras.K, np.float64)
    size = _rms(centres - centres.mean(0))
    bandwidth = max(0.04, 1.5 / len(times))  # of the whole duration, and never less than a few views

    if _rms(centres - _nearby(times, times, bandwidth) @ centres) > 0.5 * size:
        central = np.argmin(np.linalg.norm(centres - np.median(centres, axis=0), axis=-1))
        rotations, centres, intrinsics = (
            np.broadcast_to(x[central], x.shape) for x in (rotations, centres, intrinsics)
        )

    still = frames // 4
    instants = np.concatenate([np.zeros(still), np.linspace(0, 1, frames - still)])
    weights = _nearby(instants, times, bandwidth)
    turned = np.stack([Rotation.from_matrix(rotations).mean(w).as_matrix() for w in weights])
    phase = np.linspace(0, 4 * np.pi, frames)
    sway = 0.2 * size * np.stack([np.sin(phase), 0.3 * np.sin(2 * phase)], axis=-1)
    moved = weights @ centres + np.einsum("fk,fki->fi", sway, turned[:, :2])

    viewmat = np.tile(np.eye(4), (frames, 1, 1))
    viewmat[:, :3, :3] = turned
    viewmat[:, :3, 3] = -np.einsum("fij,fj->fi", turned, moved)
    K = np.einsum("fv,vij->fij", weights, intrinsics)
    path: list[Any] = [x.astype(cameras.viewmat.dtype) for x in (viewmat, K, instants)]
    return Camera(*path)


def view(cameras: Camera, index: int) -> Camera:
    """One camera of a batch."""
    return Camera(*(x[index] for x in cameras))


def expected_depth(output: RenderOutput) -> Float[np.ndarray, "H W"]:
    """Mean depth along each ray, world units: depth / alpha, and 0 where nothing is drawn."""
    alpha = np.asarray(output.alpha)
    return np.where(alpha > 0, np.asarray(output.depth) / np.where(alpha > 0, alpha, 1), 0)


def viridis(values: Float[np.ndarray, "H W"], low: float, high: float) -> UInt8[np.ndarray, "H W 3"]:
    """Colours from dark violet at `low` to yellow at `high`; black and white print keeps the order."""
    scaled = (values - low) / (high - low) if high > low else np.zeros_like(values)
    return np.ascontiguousarray(cv2.applyColorMap(to_bytes(scaled), cv2.COLORMAP_VIRIDIS)[..., ::-1])


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


def cell(picture: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture at a legible width: enlarged by whole pixels, or reduced."""
    narrow, wide = CELL_WIDTHS
    height, width = picture.shape[:2]
    if width > wide:
        return cv2.resize(picture, (wide, round(height * wide / width)), interpolation=cv2.INTER_AREA)
    factor = -(-narrow // width)
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


def text_strip(text: str, width: int) -> UInt8[np.ndarray, "h w 3"]:
    """One line of text, white on black; what does not fit is cut off."""
    strip = np.zeros((STRIP, width, 3), np.uint8)
    return cv2.putText(strip, text, (4, STRIP - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)


def _nearby(at: Float[np.ndarray, " A"], times: Float[np.ndarray, " F"], bandwidth: float) -> Float[np.ndarray, "A F"]:
    """Gaussian weights of the views around each instant; rows sum to 1."""
    exponent = -0.5 * ((at[:, None] - times[None]) / bandwidth) ** 2
    weights = np.exp(exponent - exponent.max(-1, keepdims=True))
    return weights / weights.sum(-1, keepdims=True)


def _rms(offsets: Float[np.ndarray, "F 3"]) -> float:
    return float(np.sqrt((offsets**2).sum(-1).mean()))
