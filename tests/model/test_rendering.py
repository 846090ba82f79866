import dataclasses

import finished_run
import numpy as np
import pytest

from l2dgs_jax.cameras.geometry import select_camera
from l2dgs_jax.model.rendering import Renderer, expected_depth
from l2dgs_jax.types import RenderOutput


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.getbasetemp()


def test_welllit_equals_the_full_rendering_and_enlarges_its_pair_buffer(base):
    run = finished_run.opened(base)
    camera = select_camera(run.dataset.test.cameras, 0)
    full, small_buffer = run.renderer(), run.renderer()
    small_buffer.pair_capacity = 8
    np.testing.assert_allclose(small_buffer.welllit(camera), full(camera).images.welllit, atol=1e-6)
    assert small_buffer.pair_capacity > 8


def test_expected_depth_divides_by_alpha_and_is_zero_where_alpha_is():
    zero = np.zeros(())
    output = RenderOutput(None, np.array([[0.5, 0.0]]), np.array([[1.5, 0.0]]), zero, zero, zero)
    np.testing.assert_array_equal(expected_depth(output), [[3.0, 0.0]])


@pytest.mark.parametrize("background", [0.0, 0.7])
def test_empty_pixels_show_the_background_in_illumination_and_reflectance(base, background):
    run = finished_run.opened(base)
    empty = run.state.scene._replace(alive=np.zeros_like(run.state.scene.alive))
    cfg = dataclasses.replace(run.config.model, background=background, domain="values", relative_light=False)
    width, height = run.dataset.width, run.dataset.height
    renderer = Renderer(empty, cfg, width, height, moving=True, sh_degree=1)
    images = renderer(select_camera(run.dataset.test.cameras, 0)).images
    np.testing.assert_allclose(images.illumination, np.full((height, width), background), rtol=1e-6)
    np.testing.assert_allclose(images.reflectance, np.full((height, width, 3), background), rtol=1e-6)
    np.testing.assert_allclose(images.welllit, np.full((height, width, 3), background**2), rtol=1e-6)
