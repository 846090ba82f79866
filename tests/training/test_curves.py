"""The preset `curve-4dgs`: the low-light image is a tone curve of the rendered one."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from tiny_training import FRAMES, finish, make_dataset, state_of, tiny

from l2dgs_jax.config import overrides
from l2dgs_jax.model import tone_curves
from l2dgs_jax.model.rendering import Renderer
from l2dgs_jax.training import initial_state
from l2dgs_jax.types import Camera

CONFIG = tiny("curve-4dgs")


@pytest.fixture(scope="module")
def dataset():
    return make_dataset()


def test_the_low_light_image_is_the_shared_curve_of_the_well_lit_one(dataset):
    scene = initial_state(dataset, CONFIG).scene
    renderer = Renderer(scene, CONFIG.model, dataset.width, dataset.height, moving=False, sh_degree=1)
    images = renderer(Camera(*(x[0] for x in dataset.train.cameras))).images
    shared = scene.params.curves.shared[None]
    np.testing.assert_allclose(images.lowlight, tone_curves.darkened(images.welllit[None], shared)[0], rtol=1e-6)
    assert images.welllit.mean() > 2 * images.lowlight.mean()


def test_a_preset_without_low_light_has_no_curves(dataset):
    assert initial_state(dataset, tiny("4dgs")).scene.params.curves is None


@pytest.mark.slow
def test_each_frame_learns_its_own_curve(dataset):
    """Where frames differ in brightness only, the curves learned per frame tell by how much."""
    gains = np.linspace(-0.3, 0.3, FRAMES)
    same_camera = dataset.train.cameras._replace(viewmat=dataset.train.cameras.viewmat[:1].repeat(FRAMES, 0))
    frames = np.exp(gains)[:, None, None, None] * dataset.train.images[:1].clip(0.05)
    train = dataclasses.replace(dataset.train, images=frames.astype(np.float16), cameras=same_camera)
    changes = {"optim.curves_lr": 0.02, "coarse_steps": 60, "fine_steps": 0, "loss.equalisation": 0.0}
    config = overrides.replace(CONFIG, changes)
    learned = state_of(finish(dataclasses.replace(dataset, train=train), config)).scene.params.curves
    levels = np.log(np.exp(tone_curves.of_frames(learned, jnp.arange(FRAMES))).sum(-1))
    assert np.corrcoef(levels, gains)[0, 1] > 0.9
