"""A tiny run folder as training leaves it, made once per test session.

Its scene is the initial one, with a motion field that already moves: enough for the tools that look at
runs, and no training step to compile.
"""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
from scenes import write_image, write_nerfies

from l2dgs_jax import runs
from l2dgs_jax.config import PRESETS
from l2dgs_jax.data import load_dataset
from l2dgs_jax.runs import checkpoints
from l2dgs_jax.runs.checkpoints import Checkpoint
from l2dgs_jax.training import initial_state, resolve

WIDTH, HEIGHT, FRAMES = 24, 18, 10
HELD_OUT = (2, 6)  # every fourth frame


@functools.cache
def folder(base):
    """The run folder under `base`, for the command lines; its scene lies beside it."""
    scene = write_nerfies(base / "tiny_scene", FRAMES, WIDTH, HEIGHT, num_points=40, truth=True)
    still_mask = scene / "mask" / "1x" / f"{HELD_OUT[1]:06d}.png"  # a frame in which nothing moves
    write_image(still_mask, np.zeros((HEIGHT, WIDTH)))
    preset = PRESETS["default"]
    model = dataclasses.replace(
        preset.model,
        plane_size=4,
        plane_scales=(1,),
        plane_channels=2,
        hidden=8,
        identity_start=False,
    )
    dataset = load_dataset(scene)
    config = resolve(dataclasses.replace(preset, coarse_steps=3, fine_steps=3, model=model), dataset)
    path = base / "tiny_run"
    runs.write_settings(path, str(scene), config)
    state = initial_state(dataset, config)
    for name, step in ((runs.COARSE, config.coarse_steps), (runs.CHECKPOINT, config.steps)):
        checkpoints.save(path / name, Checkpoint(state._replace(step=jnp.asarray(step, jnp.int32)), 1024), config)
    return path


@functools.cache
def opened(base):
    return runs.open_run(folder(base))


def without_truth_and_test(run):
    train = dataclasses.replace(run.dataset.train, welllit=None, masks=None)
    nothing = dataclasses.replace(train, names=())
    return dataclasses.replace(run, dataset=dataclasses.replace(run.dataset, train=train, test=nothing))
