"""A tiny run folder, trained for a few steps once per test session."""

import dataclasses
import functools

import numpy as np
from scenes import write_image, write_nerfies

from l2dgs_jax import checkpoint, engine, runs
from l2dgs_jax.checkpoint import Checkpoint
from l2dgs_jax.config import PRESETS
from l2dgs_jax.data import load

WIDTH, HEIGHT, FRAMES = 24, 18, 10
HELD_OUT = (2, 6)  # every fourth frame


@functools.cache
def folder(base):
    """The run folder under `base`, for the command lines; its scene lies beside it."""
    scene = write_nerfies(base / "tiny_scene", FRAMES, WIDTH, HEIGHT, num_points=40, truth=True)
    still = scene / "mask" / "1x" / f"{HELD_OUT[1]:06d}.png"  # a frame in which nothing moves
    write_image(still, np.zeros((HEIGHT, WIDTH)))
    preset = PRESETS["default"]
    model = dataclasses.replace(
        preset.model,
        plane_size=4,
        plane_scales=(1,),
        plane_channels=2,
        hidden=8,
        initial_exponents=(1.2, 6.0),
    )
    config = dataclasses.replace(preset, coarse_steps=3, fine_steps=3, model=model)
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
