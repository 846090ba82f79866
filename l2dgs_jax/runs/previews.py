"""Previews: small pictures of two views of a scene while it trains, in its run folder."""

import re
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import UInt8

from l2dgs_jax.config import Config
from l2dgs_jax.data import Dataset
from l2dgs_jax.data.images import encode_jpeg, to_bytes
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runtime.files import make_folder, replacing
from l2dgs_jax.training.state import TrainState

PREVIEWS = "previews"
VIEWS = {"held-out": "test", "training": "train"}  # names of the views, and the splits that they are from
INPUT, LOWLIGHT, WELLLIT = "input", "lowlight", "welllit"
MAX_MOMENTS, MIN_STEPS_APART = 8, 100  # moments of a run at which previews are drawn, and steps between them
LONG_COARSE_STAGE = 1000  # steps from which on a coarse stage has previews, for which a renderer must be compiled
MAX_WIDTH, JPEG_QUALITY = 320, 85  # pixels


class Preview(NamedTuple):
    """A preview in a run folder.

    Attributes:
        view: key of `VIEWS`.
        kind: what it shows: INPUT, LOWLIGHT or WELLLIT.
        step: after which it was drawn; None for the input frame.
        path: of the file.
    """

    view: str
    kind: str
    step: int | None
    path: Path


def first(config: Config) -> int:
    """Number of steps before previews begin: the coarse stage, unless it is long or the only stage."""
    return 0 if config.coarse_steps >= LONG_COARSE_STAGE or not config.fine_steps else config.coarse_steps


def moments(config: Config) -> frozenset[int]:
    """The steps after which previews are drawn, evenly spaced and beginning after `first`.

    Those of the fine stage use the program that is compiled anyway for the pictures at the end of the run.
    """
    count = min(MAX_MOMENTS, max(config.steps // MIN_STEPS_APART, 1))
    evenly = (round(config.steps * part / count) for part in range(1, count + 1))
    return frozenset(step for step in evenly if step > first(config))


def draw(folder: Path, dataset: Dataset, config: Config, state: TrainState) -> list[Path]:
    """Draw the held-out view and the training view that are in the middle of the clip.

    Args:
        folder: of the run, which exists.
        dataset: its scene.
        config: its settings, resolved by `training.resolve`.
        state: the present state.

    Returns:
        The new files.

    Raises:
        UserError: a file cannot be written.
    """
    run = Run(config, dataset, state)
    files: list[Path] = []
    for view, split_name in VIEWS.items():
        split = getattr(dataset, split_name)
        if not len(split.names):
            continue
        middle = int(np.argsort(split.cameras.time, kind="stable")[len(split.names) // 2])
        images = jax.device_get(run.render(split.camera(middle)).images)
        shown = {_path(folder, view, INPUT): split.images[middle]}
        shown |= {_path(folder, view, kind, int(state.step)): getattr(images, kind) for kind in (LOWLIGHT, WELLLIT)}
        for path, image in shown.items():
            _write(path, to_bytes(image))
        files += shown
    return files


def kept(folder: Path) -> list[Preview]:
    """The previews in a run folder, ordered by view, kind and step."""
    found = []
    for view in VIEWS:
        for path in sorted((folder / PREVIEWS / view).glob("*.jpg")):
            name = re.fullmatch(r"([a-z]+)(?:-(\d+))?\.jpg", path.name)
            if name:
                found.append(Preview(view, name[1], int(name[2]) if name[2] else None, path))
    return found


def drop_after(folder: Path, step: int) -> None:
    """Remove the previews of later steps than `step`, for a run that resumes from its last checkpoint."""
    for preview in kept(folder):
        if preview.step is not None and preview.step > step:
            preview.path.unlink()


def _path(folder: Path, view: str, kind: str, step: int | None = None) -> Path:
    return folder / PREVIEWS / view / (f"{kind}.jpg" if step is None else f"{kind}-{step:06d}.jpg")


def _write(path: Path, picture: UInt8[np.ndarray, "H W 3"]) -> None:
    height, width = picture.shape[:2]
    if width > MAX_WIDTH:
        picture = cv2.resize(picture, (MAX_WIDTH, round(height * MAX_WIDTH / width)), interpolation=cv2.INTER_AREA)
    make_folder(path.parent)
    with replacing(path) as temporary:
        temporary.write_bytes(encode_jpeg(picture, JPEG_QUALITY))
