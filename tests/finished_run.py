"""A tiny run folder, trained for a few steps once per test session."""

import dataclasses
import functools
import json

import numpy as np

from l2dgs_jax import checkpoint, engine, runs
from l2dgs_jax.checkpoint import Checkpoint
from l2dgs_jax.config import PRESETS
from l2dgs_jax.data import load
from l2dgs_jax.visualize import to_bytes, write_image

WIDTH, HEIGHT, FRAMES = 24, 18, 9
HELD_OUT = (2, 4, 7)


@functools.cache
def folder(base):
    """The run folder under `base`, for the command lines; its scene lies beside it."""
    scene = base / "tiny_scene"
    write_scene(scene)
    preset = PRESETS["default"]
    config = dataclasses.replace(
        preset,
        coarse_steps=3,
        fine_steps=3,
        model=dataclasses.replace(preset.model, plane_size=4, plane_scales=(1,), plane_channels=2, hidden=8),
    )
    path = base / "tiny_run"
    dataset = load(scene)
    runs.write_settings(path, str(scene), config)
    for state, _, pairs in engine.run(dataset.train, config, engine.initial_state(dataset, config)):
        if int(state.step) == config.coarse_steps:
            checkpoint.save(path / runs.COARSE, Checkpoint(state, pairs), config)
    checkpoint.save(path / runs.CHECKPOINT, Checkpoint(state, pairs), config)
    return path


@functools.cache
def opened(base):
    return runs.open_run(folder(base))


def without_truth_and_test(run):
    train = dataclasses.replace(run.dataset.train, welllit=None, masks=None)
    nothing = dataclasses.replace(train, names=())
    return dataclasses.replace(run, dataset=dataclasses.replace(run.dataset, train=train, test=nothing))


def write_scene(scene):
    """Nerfies' layout, with truth and masks; in one held-out frame nothing is marked as moving."""
    rng = np.random.default_rng(0)
    names = [f"{i:03d}" for i in range(FRAMES)]
    for part in ("camera", "rgb/1x", "well/1x", "mask/1x"):
        (scene / part).mkdir(parents=True)
    base = rng.uniform(0.2, 0.9, (HEIGHT, WIDTH, 3))
    for i, name in enumerate(names):
        well = np.roll(base, i, axis=1)
        mask = np.zeros((HEIGHT, WIDTH))
        if i != HELD_OUT[1]:
            mask[3:12, i : i + 9] = 1
        write_image(scene / "well/1x" / f"{name}.png", to_bytes(well))
        write_image(scene / "rgb/1x" / f"{name}.png", to_bytes(0.2 * well + rng.normal(0, 0.01, well.shape)))
        write_image(scene / "mask/1x" / f"{name}.png", to_bytes(np.repeat(mask[..., None], 3, -1)))
        camera = {
            "orientation": np.eye(3).tolist(),
            "position": [0.1 * i - 0.4, 0.02 * (i % 2), 0.0],
            "focal_length": 20.0,
            "principal_point": [WIDTH / 2, HEIGHT / 2],
            "image_size": [WIDTH, HEIGHT],
        }
        (scene / "camera" / f"{name}.json").write_text(json.dumps(camera))
    split = {
        "val_ids": [names[i] for i in HELD_OUT],
        "train_ids": [n for i, n in enumerate(names) if i not in HELD_OUT],
    }
    (scene / "dataset.json").write_text(json.dumps({"ids": names} | split))
    np.save(scene / "points.npy", rng.uniform([-1, -0.8, 1.5], [1, 0.8, 3], (40, 3)))
