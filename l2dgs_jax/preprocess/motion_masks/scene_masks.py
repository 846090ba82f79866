"""Masks of what moves in a scene: computed, previewed, and written beside its pictures."""

import os
import tempfile
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8
from tqdm import tqdm

from l2dgs_jax.cameras.flow import brightened
from l2dgs_jax.data.color import brightening_exponent
from l2dgs_jax.data.dataset import Dataset, Original
from l2dgs_jax.data.images import to_bytes, write_image
from l2dgs_jax.data.lens import distorted
from l2dgs_jax.data.stacks import MappedArray, evenly_spread, stacked
from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.motion_masks.detection import moving_masks
from l2dgs_jax.types import Camera
from l2dgs_jax.visualize.sheet import sheet

PREVIEW_ROWS = 12
PREVIEW_LEVEL = 0.45  # mean to which the preview's pictures are brightened


def compute_masks(dataset: Dataset) -> Bool[np.ndarray, "F H W"]:
    """Masks of what moves, first of the training frames and then of the held-out ones; shows progress.

    Frames of both splits are matched with each other, because held-out frames are few.

    Raises:
        UserError: all frames have the same instant.
    """
    cameras, images = _all_frames(dataset)
    masks = np.zeros(images.shape[:3], bool)
    try:
        found = moving_masks(cameras, images, dataset.points)
        for frame, mask in tqdm(found, total=len(masks), desc="masks", unit="frame", dynamic_ncols=True):
            masks[frame] = mask
    except UserError as error:
        raise UserError(f"{dataset.name}: {error}") from None
    return masks


def as_taken(mask: Bool[np.ndarray, "h w"], downscale: int, original: Original) -> Bool[np.ndarray, "H W"]:
    """Turn a mask of a frame as loaded into a mask of the original picture: full size, with lens distortion."""
    width, height = original.size
    full = mask.astype(np.uint8).repeat(downscale, axis=0).repeat(downscale, axis=1)
    full = np.pad(full, ((0, height - full.shape[0]), (0, width - full.shape[1])), mode="edge")
    return distorted(full, original.K, original.lens) > 0


def write_masks(folder: Path, names: Sequence[str], masks: Sequence[Bool[np.ndarray, "H W"]]) -> None:
    """Write `folder/1x/NAME.png`, all of them or none; they replace the previous content of `folder`.

    Raises:
        UserError: the folder cannot be written.
    """
    try:
        # Written to a temporary folder beside `folder`, so that an interruption does not leave some of the masks.
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".mask-", ignore_cleanup_errors=True) as top:
            new, old = Path(top) / "new", Path(top) / "old"
            for name, mask in zip(names, masks, strict=True):
                path = new / "1x" / f"{name}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                write_image(path, 255 * mask.astype(np.uint8))
            try:
                if folder.exists():
                    os.rename(folder, old)
                os.rename(new, folder)
            except BaseException:  # or the old masks would be removed with the temporary folder
                if old.exists():
                    os.rename(old, folder)
                raise
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror}); expected a writable folder") from None


def preview(dataset: Dataset, masks: Bool[np.ndarray, "F H W"]) -> UInt8[np.ndarray, "h w 3"]:
    """Some training and held-out frames, spread over time: as they are, brightened for matching, with masks in red.

    Args:
        dataset: the scene.
        masks: of its training and then its held-out frames.
    """
    cameras, images = _all_frames(dataset)
    names = [*dataset.train.names, *dataset.test.names]
    held_out = np.arange(len(names)) >= len(dataset.train.names)
    chosen: list[int] = []
    for part in (~held_out, held_out):
        frames = np.flatnonzero(part)[np.argsort(cameras.time[part], kind="stable")]
        chosen += frames[evenly_spread(len(frames), PREVIEW_ROWS // 2)].tolist()

    exponent = brightening_exponent(float(images[chosen].mean(dtype=np.float64)), PREVIEW_LEVEL)
    rows = []
    for frame, grey in zip(chosen, brightened(images[chosen]), strict=True):
        bright = np.clip(images[frame].astype(np.float32), 0, 1) ** exponent
        tinted = np.where(masks[frame][..., None], 0.5 * bright + (0.5, 0, 0), bright)
        pictures = [to_bytes(images[frame]), np.repeat(grey[..., None], 3, axis=-1), to_bytes(tinted)]
        kind = "held out" if held_out[frame] else "trained on"
        area = 100 * masks[frame].mean()
        rows.append((f"{names[frame]}, time {cameras.time[frame]:.2f}, {kind}, {area:.1f} % moves", pictures))
    return sheet(("input", "as matched", "mask"), rows)


def _all_frames(dataset: Dataset) -> tuple[Camera, np.ndarray]:
    """Cameras and images of both splits."""
    both = (dataset.train, dataset.test)
    parts: list[Any] = [np.concatenate(arrays) for arrays in zip(*(split.cameras for split in both), strict=True)]
    images, others = (split.images for split in both)
    shape = (len(images) + len(others), *images.shape[1:])
    in_file = isinstance(images, MappedArray) or isinstance(others, MappedArray)
    return Camera(*parts), stacked(chain(images, others), shape, images.dtype, in_file)
