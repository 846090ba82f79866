"""A scene and settings so small that training takes seconds."""

import collections
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from l2dgs_jax.config import PRESETS, DensityConfig
from l2dgs_jax.data import Dataset, Split
from l2dgs_jax.runtime import devices
from l2dgs_jax.training import engine, initial_state
from l2dgs_jax.training.batching import load_batch
from l2dgs_jax.training.state import StepReport
from l2dgs_jax.types import Camera

WIDTH, HEIGHT, FRAMES = 16, 12, 6


def tiny(preset="default", **changes):
    base = PRESETS[preset]
    exponents = base.model.initial_exponents and (1.5, 9.0)
    illumination = base.model.initial_illumination and 0.8
    small = dataclasses.replace(
        base.model,
        initial_exponents=exponents,
        initial_illumination=illumination,
        exposure="steady",
        tone="linear-light" if base.model.tone == "auto" else base.model.tone,
        tracks=False,
        surfaces=False,
        plane_size=4,
        plane_scales=(1, 2),
        plane_channels=2,
        hidden=8,
        sh_degree=1,
    )
    level = 0.46 if base.loss.exposure_level == "auto" else base.loss.exposure_level
    loss = dataclasses.replace(base.loss, exposure_level=level)
    density = DensityConfig(start=1, stop=100, interval=3, grad_threshold=1e-9, max_gaussians=60)
    few = {"coarse_steps": 4, "fine_steps": 4, "sh_warmup": 3, "inbetweens": 0.0}
    return dataclasses.replace(base, **few | {"density": density, "loss": loss, "model": small} | changes)


def make_dataset(seed=0, width=WIDTH, height=HEIGHT):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -0.7, 2], [1, 0.7, 3], (25, 3)).astype(np.float32)
    viewmat = np.tile(np.eye(4, dtype=np.float32), (FRAMES, 1, 1))
    viewmat[:, 0, 3] = np.linspace(-0.2, 0.2, FRAMES)
    intrinsics = np.tile(np.array([[14, 0, 8], [0, 14, 6], [0, 0, 1]], np.float32), (FRAMES, 1, 1))
    cameras = Camera(viewmat, intrinsics, np.linspace(0, 1, FRAMES, dtype=np.float32))
    images = rng.uniform(0, 0.2, (FRAMES, height, width, 3)).astype(np.float16)
    split = Split(tuple(map(str, range(FRAMES))), cameras, images, None, None)
    return Dataset("tiny", width, height, split, split, points, None)


def batch_of(split, frames):
    """A batch as JAX arrays, floats in the precision of the tests."""
    batch = load_batch(split, np.array(frames))
    return jax.tree.map(lambda x: jnp.asarray(x, float) if x.dtype.kind == "f" else jnp.asarray(x), batch)


def uneven(params, seed=1):
    """The same parameters with a motion field that moves every Gaussian in its own way."""
    rng = np.random.default_rng(seed)
    disturbed = lambda tree: jax.tree.map(lambda x: x + jnp.asarray(rng.normal(0, 0.3, x.shape), x.dtype), tree)
    return params._replace(hexplane=disturbed(params.hexplane), heads=disturbed(params.heads))


def report(loss=0.0):
    """The report of a step that is not computed."""
    zero, no = jnp.zeros(1), jnp.zeros(1, bool)
    return StepReport(zero + loss, {"l1": zero}, zero, jnp.zeros(1, jnp.int32), no, no)


def finish(dataset, config, state=None, pair_capacity=None):
    """The progress after the last step of a run."""
    member = engine.Member(dataset.train, config, state or initial_state(dataset, config))
    return collections.deque(engine.run([member], pair_capacity), maxlen=1).pop()


def state_of(progress, member=0):
    return devices.member(progress.states, member)


def assert_equal_states(a, b):
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y, err_msg=jax.tree_util.keystr(path))
