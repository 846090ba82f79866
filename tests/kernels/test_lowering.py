"""Programs lowered for other platforms contain nothing of the forms for CPUs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_training import HEIGHT, WIDTH, batch_of, make_dataset, tiny

from l2dgs_jax.cameras import select_camera
from l2dgs_jax.kernels import use_kernels
from l2dgs_jax.model.rendering import render
from l2dgs_jax.rasterizer import rasterize
from l2dgs_jax.training import initial_state
from l2dgs_jax.training.step import train_step

MARKS = ("small_call", "inlineable")  # of functions compiled separately for a CPU
CONFIG = tiny(sh_warmup=1)


def scene():
    random = np.random.default_rng(0)
    shapes = (50, 3), (50, 4), (50, 3), (50,), (50, 6)
    camera = jnp.eye(4), jnp.array([[60.0, 0, 40], [0, 60, 40], [0, 0, 1]])
    return *(jnp.asarray(random.uniform(0.1, 1, shape)) for shape in shapes), *camera


def draw(*arrays):
    return rasterize(*arrays, 80, 80, pair_capacity=4096)


def gradient(*arrays):
    return jax.grad(lambda *arrays: sum(x.sum() for x in draw(*arrays)[:3]), range(7))(*arrays)


@pytest.fixture(scope="module")
def programs():
    """Functions and their arguments, by name."""
    dataset = make_dataset()
    state = initial_state(dataset, CONFIG)
    batch = batch_of(dataset.train, [0, 3])
    step = lambda state, batch: train_step(state, batch, CONFIG, moving=True, pair_capacity=4096)
    cameras = jax.tree.map(lambda x: jnp.asarray(x, float)[None], select_camera(dataset.train.cameras, 0))
    shape = {"moving": True, "sh_degree": 1, "pair_capacity": 4096}
    view = lambda scene, cameras: render(scene, cameras, CONFIG.model, 2 * WIDTH, 2 * HEIGHT, **shape)
    return {
        "rasterizer": (draw, scene()),
        "gradient": (gradient, scene()),
        "train step": (step, (state, batch)),
        "renderer": (view, (state.scene, cameras)),
    }


@pytest.mark.parametrize("platform", ["cuda", "rocm", "tpu"])
@pytest.mark.parametrize("name", ["rasterizer", "gradient", "train step", "renderer"])
def test_no_other_platform_gets_the_forms_for_cpus(programs, name, platform):
    function, arguments = programs[name]
    text = jax.jit(function).trace(*arguments).lower(lowering_platforms=(platform,)).as_text()
    assert not [mark for mark in (*MARKS, "cpu") if mark in text]


@pytest.mark.parametrize("name", ["rasterizer", "gradient", "train step", "renderer"])
def test_a_cpu_gets_the_forms_for_cpus(programs, name):
    function, arguments = programs[name]
    text = jax.jit(function).trace(*arguments).lower().as_text()
    assert all(mark in text for mark in MARKS)


def test_the_accelerator_form_can_be_chosen_on_a_cpu():
    with use_kernels("accelerator"):
        text = jax.jit(gradient).trace(*scene()).lower().as_text()
    assert not [mark for mark in MARKS if mark in text]
