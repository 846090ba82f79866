"""Two views of a scene while it trains, as small pictures in its run folder."""

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
from l2dgs_jax.runtime.capacity import next_capacity
from l2dgs_jax.runtime.files import make_folder, replacing
from l2dgs_jax.training.state import TrainState, with_capacity

PREVIEWS = "previews"
VIEWS = {"held-out": "test", "training": "train"}  # of which split
INPUT, LOWLIGHT, WELLLIT = "input", "lowlight", "welllit"
MOST, APART = 8, 100  # moments of a run, and steps between them at least
LONG = 1000  # steps of a coarse stage that are worth the compilation of a program of its own
WIDTH, QUALITY = 320, 85  # pixels at most; of JPEG


class Preview(NamedTuple):
    """A picture that lies in a run folder.

    Attributes:
        view: of `VIEWS`.
        kind: what it shows.
        step: after which; None for the frame itself.
        path: of the file.
    """

    view: str
    kind: str
    step: int | None
    path: Path


def first(config: Config) -> int:
    """The step after which views can be drawn by the program that draws those at the end."""
    return 0 if config.coarse_steps >= LONG or not config.fine_steps else config.coarse_steps


def moments(config: Config) -> frozenset[int]:
    """The steps after which views are drawn: by the program that draws the pictures at the end, compiled for both."""
    count = min(MOST, max(config.steps // APART, 1))
    evenly = (round(config.steps * part / count) for part in range(1, count + 1))
    return frozenset(step for step in evenly if step > first(config))


def draw(folder: Path, dataset: Dataset, config: Config, state: TrainState) -> list[Path]:
    """Draw the views in the middle of the held-out and of the training ones.

    Args:
        folder: of the run, which exists.
        dataset: its scene.
        config: its settings, what they left to the data filled in.
        state: where it stands.

    Returns:
        The new files.

    Raises:
        UserError: a file cannot be written.
    """
    run = Run(config, dataset, with_last_capacity(state, config))
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
    """The pictures that lie in a run folder, in the order of their steps."""
    found = []
    for view in VIEWS:
        for path in sorted((folder / PREVIEWS / view).glob("*.jpg")):
            name = re.fullmatch(r"([a-z]+)(?:-(\d+))?\.jpg", path.name)
            if name:
                found.append(Preview(view, name[1], int(name[2]) if name[2] else None, path))
    return found


def drop_after(folder: Path, step: int) -> None:
    """Remove the pictures of later steps, from a run that goes on from its last checkpoint."""
    for preview in kept(folder):
        if preview.step is not None and preview.step > step:
            preview.path.unlink()


def _path(folder: Path, view: str, kind: str, step: int | None = None) -> Path:
    return folder / PREVIEWS / view / (f"{kind}.jpg" if step is None else f"{kind}-{step:06d}.jpg")


def with_last_capacity(state: TrainState, config: Config) -> TrainState:
    """With as many rows as at the end of the run, as far as that is known: every number of rows is a compilation."""
    cfg, rows = config.density, len(state.scene.alive)
    most = int(cfg.max_gaussians) if cfg.method == "mcmc" and cfg.start < cfg.stop else 0
    return with_capacity(state, next_capacity(most)) if most > rows else state


def _write(path: Path, picture: UInt8[np.ndarray, "H W 3"]) -> None:
    height, width = picture.shape[:2]
    if width > WIDTH:
        picture = cv2.resize(picture, (WIDTH, round(height * WIDTH / width)), interpolation=cv2.INTER_AREA)
    make_folder(path.parent)
    with replacing(path) as temporary:
        temporary.write_bytes(encode_jpeg(picture, QUALITY))
