"""Baked colours: a file, drawn without anything else, shows the well-lit scene."""

import dataclasses

import finished_run
import jax.numpy as jnp
import numpy as np
import pytest

from l2dgs_jax import rasterize
from l2dgs_jax.data.color import linear_to_srgb, srgb_to_linear
from l2dgs_jax.exporters import baking, ply
from l2dgs_jax.exporters.splats import visible

TIMES = (0.3, 0.8)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run that moves, with a dead row, and whose reflectances leave [0, 1] as those of trained ones do."""
    run = finished_run.opened(tmp_path_factory.getbasetemp())
    rng = np.random.default_rng(0)
    scene = run.state.scene
    params = scene.params
    time = tuple(plane + jnp.asarray(rng.normal(0, 0.5, plane.shape)) for plane in params.hexplane.time)
    params = params._replace(
        gaussians=params.gaussians._replace(reflectance=1.6 * params.gaussians.reflectance - 0.3),
        hexplane=params.hexplane._replace(time=time),
    )
    scene = scene._replace(params=params, alive=scene.alive.at[3].set(False))
    return dataclasses.replace(run, state=run.state._replace(scene=scene))


@pytest.fixture(scope="module")
def baked(run):
    return list(baking.bake(run, TIMES))


def read(data):
    """Activated values of a .ply of Gaussians."""
    head, _, body = data.partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property float")]
    rows = np.frombuffer(body, "<f4").reshape(-1, len(names)).astype(float)
    columns = lambda *wanted: rows[:, [names.index(name) for name in wanted]]
    return (
        columns("x", "y", "z"),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        np.exp(columns("scale_0", "scale_1", "scale_2")),
        1 / (1 + np.exp(-columns("opacity")[:, 0])),
        0.5 + 0.28209479177387814 * columns("f_dc_0", "f_dc_1", "f_dc_2"),
    )


def images(gaussians, run):
    """Gaussians with colours, rendered from every other training camera."""
    viewmat, K = (jnp.asarray(x[1::2], float) for x in run.dataset.train.cameras[:2])
    size = run.dataset.width, run.dataset.height
    return np.asarray(rasterize(*(jnp.asarray(x, float) for x in gaussians), viewmat, K, *size).features)


def exact_images(time, run):
    """The well-lit images of the same cameras."""
    split, renderer = run.dataset.train, run.renderer()
    return np.stack([renderer.welllit(split.camera(i)._replace(time=time)) for i in range(1, len(split.names), 2)])


def test_a_file_alone_shows_the_well_lit_scene(run, baked):
    for time, (splats,) in zip(TIMES, baked, strict=True):
        shown = images(read(ply.encode(visible(splats))), run)
        assert np.abs(shown - exact_images(time, run)).mean() < 0.02


def test_splats_are_the_living_gaussians_with_colours_in_range(run, baked):
    alive = int(run.state.scene.alive.sum())
    for (splats,) in baked:
        assert {len(rows) for rows in splats} == {alive}
        assert splats.colors.min() >= 0
        assert splats.colors.max() <= 1
        np.testing.assert_allclose(np.linalg.norm(splats.quats, axis=-1), 1, atol=1e-6)
    assert np.abs(baked[0][0].means - baked[1][0].means).max() > 1e-4  # it moves


def test_the_fit_brings_colours_closer_at_every_instant(run, baked, monkeypatch):
    monkeypatch.setattr(baking, "FIRST_ITERATIONS", 0)
    (unfitted,) = next(baking.bake(run, TIMES))
    unfitted = baking.closeness(run, unfitted, TIMES[0])
    assert all(baking.closeness(run, *splats, time) > unfitted + 3 for splats, time in zip(baked, TIMES, strict=True))


def test_colours_beyond_one_come_closer(run, baked):
    (splats,) = next(baking.bake(run, TIMES, brightest=1.25))
    assert 1 < splats.colors.max() <= 1.25
    assert baking.closeness(run, splats, TIMES[0]) > baking.closeness(run, *baked[0], TIMES[0])


def test_closeness_is_measured_in_views_not_fitted_to(run, baked):
    for time, (splats,) in zip(TIMES, baked, strict=True):
        errors = np.square(images(splats, run) - exact_images(time, run)).mean((1, 2, 3))
        closeness = baking.closeness(run, splats, time)
        assert closeness == pytest.approx(-10 * np.log10(errors).mean(), abs=0.01)


@pytest.mark.slow
def test_colours_of_low_light_images_are_fitted_along_with_those_of_well_lit_ones(run, baked):
    welllit, lowlight = next(baking.bake(run, TIMES, images=("welllit", "lowlight")))
    np.testing.assert_allclose(welllit.colors, baked[0][0].colors, atol=1e-6)
    np.testing.assert_array_equal(welllit.means, lowlight.means)
    assert lowlight.colors.mean() < 0.6 * welllit.colors.mean()
    assert baking.closeness(run, lowlight, TIMES[0], "lowlight") > baking.closeness(run, welllit, TIMES[0]) - 3


@pytest.mark.slow
def test_the_background_is_not_baked_into_colours(run):
    model = dataclasses.replace(run.config.model, background=0.8)
    bright = dataclasses.replace(run, config=dataclasses.replace(run.config, model=model))
    (splats,) = next(baking.bake(bright, TIMES))
    camera = run.dataset.train.camera(1)._replace(time=TIMES[0])
    arrays = [jnp.asarray(x, float) for x in (*splats, camera.viewmat, camera.K)]
    drawn = rasterize(*arrays, run.dataset.width, run.dataset.height)
    assert drawn.alpha.min() < 0.9
    exact = bright.renderer().welllit(camera)
    assert jnp.abs(drawn.features + 0.64 * (1 - drawn.alpha[..., None]) - exact).mean() < 0.04


LIGHT = {"domain": "light", "relative_light": True, "initial_illumination": 0.9}
VALUES = {"domain": "values", "relative_light": False}


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (VALUES, 0.64),
        (LIGHT, linear_to_srgb(0.8 / 0.9 * srgb_to_linear(np.full(1, 0.8)))[0]),
        ({"decomposition": "none"}, 0.8),
        ({"decomposition": "curve"}, 0.8),
    ],
)
def test_the_background_is_the_well_lit_image_of_an_empty_scene(run, settings, expected):
    model = dataclasses.replace(run.config.model, background=0.8, **settings)
    bare = dataclasses.replace(run, config=dataclasses.replace(run.config, model=model))
    assert baking.background(bare) == pytest.approx(expected)
    nothing = run.state.scene._replace(alive=jnp.zeros_like(run.state.scene.alive))
    empty = dataclasses.replace(bare, state=run.state._replace(scene=nothing))
    welllit = empty.renderer().welllit(run.dataset.train.camera(0))
    np.testing.assert_allclose(welllit, expected, rtol=1e-6)
