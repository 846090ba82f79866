"""Scenes of any size to measure on: random clouds that fill the view, as in the golden tests, and whole models."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logit

from l2dgs_jax.config import Config, overrides
from l2dgs_jax.data.dataset import Dataset, Split
from l2dgs_jax.data.stacks import stacked
from l2dgs_jax.model.initialisation import pad_rows, path_knots
from l2dgs_jax.runtime.capacity import next_capacity
from l2dgs_jax.training import initial_state
from l2dgs_jax.training.batching import load_batch
from l2dgs_jax.training.state import Batch, TrainState
from l2dgs_jax.training.step import begin_stage
from l2dgs_jax.types import Camera

PATH_SHARE = 0.1  # of the Gaussians follow a path


def cloud(count: int, width: int, height: int, *, channels: int = 6, seed: int = 0) -> dict[str, np.ndarray]:
    """Gaussians at depths 2 to 6 that fill a 60 degree view and a little more.

    Their sizes in the world depend only on `count`, so their footprints in pixels grow with the resolution.
    """
    rng = np.random.default_rng(seed)
    focal = width / (2 * np.tan(np.deg2rad(30)))
    z = rng.uniform(2, 6, count)
    x = rng.uniform(-1.1, 1.1, count) * (width / 2 / focal) * z
    y = rng.uniform(-1.1, 1.1, count) * (height / 2 / focal) * z
    angle = np.deg2rad(20.0)
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    translation = np.array([0.1, -0.2, 0.3])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, translation
    scales = np.exp(rng.normal(np.log(3 / np.sqrt(count)), 0.5, (count, 3)))
    quats = rng.normal(size=(count, 4))
    arrays = {
        "means": (np.stack([x, y, z], 1) - translation) @ rotation,
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": scales,
        "opacities": 1 / (1 + np.exp(-rng.normal(0, 1.5, count))),
        "features": rng.uniform(0, 1, (count, channels)),
        "viewmat": viewmat,
        "K": np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]),
    }
    return {name: np.asarray(array, np.float32) for name, array in arrays.items()}


def video(count: int, width: int, height: int, frames: int, *, in_file: bool = False) -> Dataset:
    """A data set of frames of different noise, with cameras around a `cloud`."""
    arrays = cloud(count, width, height)
    rng = np.random.default_rng(1)
    viewmats = np.tile(arrays["viewmat"], (frames, 1, 1))
    viewmats[:, :3, 3] += rng.normal(0, 0.1, (frames, 3))
    cameras = Camera(
        viewmats.astype(np.float32),
        np.tile(arrays["K"], (frames, 1, 1)),
        np.linspace(0, 1, frames, dtype=np.float32),
    )
    noise = rng.uniform(0, 0.2, (height, width, 3)).astype(np.float16)
    rolled = (np.roll(noise, frame, axis=1) for frame in range(frames))
    split = Split(
        tuple(map(str, range(frames))), cameras, stacked(rolled, (frames, *noise.shape), noise.dtype, in_file)
    )
    return Dataset("cloud", width, height, split, split, arrays["means"])


def fine_state(dataset: Dataset, config: Config, moving_share: float = 1.0) -> TrainState:
    """The state at the start of the fine stage, with the `cloud` of a `video` as Gaussians and paths without motion.

    If there are motion gates, those of all but `moving_share` of the Gaussians, drawn at random, are shut. With
    `model.tracks`, a part of the Gaussians follow paths.
    """
    count, frames = len(dataset.points), len(dataset.train.names)
    arrays = cloud(count, dataset.width, dataset.height)
    # Tracks and surfaces found in noise would add Gaussians.
    alone = overrides.replace(config, {"model.tracks": False, "model.surfaces": False})
    scene = initial_state(dataset, alone).scene
    rows = partial(pad_rows, capacity=len(scene.alive))
    gaussians = scene.params.gaussians._replace(
        quats=rows(jnp.asarray(arrays["quats"])),
        log_scales=rows(jnp.log(arrays["scales"])),
        logit_opacities=rows(logit(arrays["opacities"])),
    )
    drawn = np.random.default_rng(2).uniform(size=len(scene.alive))
    paths = path_of = None
    if config.model.tracks:
        lifetimes = np.where(drawn[:, None] < PATH_SHARE, [0.0, 1.0], [-np.inf, np.inf])
        gaussians = gaussians._replace(lifetimes=jnp.asarray(lifetimes, float))
        paths = jnp.zeros((next_capacity(PATH_SHARE * count), path_knots(config.model, frames), 3))
        path_of = jnp.arange(len(drawn), dtype=jnp.int32) % len(paths)
    if gaussians.gate is not None:
        gaussians = gaussians._replace(gate=jnp.where(drawn >= moving_share, -np.inf, gaussians.gate))
    scene = scene._replace(params=scene.params._replace(gaussians=gaussians, paths=paths), path_of=path_of)
    return begin_stage(scene, jnp.asarray(config.coarse_steps, jnp.int32), config, config.fine_steps)


def training(
    count: int, width: int, height: int, config: Config, moving_share: float = 1.0
) -> tuple[TrainState, Batch]:
    """A fine-stage state and a batch of noise to fit it to; for `moving_share` see `fine_state`."""
    dataset = video(count, width, height, frames=60)
    indices = np.linspace(0, len(dataset.train.names) - 1, config.batch_size).astype(int)
    return fine_state(dataset, config, moving_share), load_batch(dataset.train, indices)
