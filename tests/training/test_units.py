"""The unit of lengths: training does not depend on the size of the scene, and works with a static camera."""

import dataclasses

import jax
import numpy as np
import pytest
from tiny_training import finish, make_dataset, state_of, tiny

from l2dgs_jax.model.rendering import Renderer
from l2dgs_jax.training import initial_state


def configure(unit, method="mcmc"):
    """Settings under which nothing magnifies rounding errors: neither Adam in quaternions nor pixels about to clip."""
    config = tiny(coarse_steps=0, fine_steps=8)
    rates = {"means_lr": 1e-2, "heads_lr": 1e-2, "quats_lr": 0.0, "eps": 1e-40}
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, unit=unit, relative_light=False),
        optim=dataclasses.replace(config.optim, extent_scales=("means",), **rates),
        loss=dataclasses.replace(config.loss, depth=0.1, scale=0.1, opacity=0.1),
        density=dataclasses.replace(config.density, method=method, start=0, interval=2, max_gaussians=40, noise=20.0),
    )


def scaled(dataset, factor):
    def enlarge(split):
        viewmat = split.cameras.viewmat.copy()
        viewmat[:, :3, 3] *= factor
        return dataclasses.replace(split, cameras=split.cameras._replace(viewmat=viewmat))

    splits = {"train": enlarge(dataset.train), "test": enlarge(dataset.test)}
    return dataclasses.replace(dataset, points=factor * dataset.points, **splits)


def trained(dataset, config):
    """The trained scene, and its renderings for the first and last camera."""
    scene = state_of(finish(dataset, config)).scene
    renderer = Renderer(scene, config.model, dataset.width, dataset.height, moving=True, sh_degree=1)
    return scene, [renderer(dataset.train.camera(i)) for i in (0, -1)]


@pytest.mark.parametrize(
    ("factor", "method"),
    [(1024.0, "mcmc"), (1 / 1024, "mcmc"), pytest.param(1024.0, "adaptive", marks=pytest.mark.slow)],
)
def test_a_scene_of_another_size_trains_to_the_same_images(factor, method):
    dataset, config = make_dataset(), configure("depth", method)
    scene, views = trained(dataset, config)
    large, large_views = trained(scaled(dataset, factor), config)
    np.testing.assert_array_equal(large.alive, scene.alive)
    np.testing.assert_allclose(large.extent, factor * scene.extent, rtol=1e-6)
    means, large_means = scene.params.gaussians.means, large.params.gaussians.means
    # Adam takes whole steps on gradients that are mere rounding: a coordinate in a thousand may differ by one.
    assert np.quantile(np.abs(large_means / factor - means), 0.999) < 2e-3
    assert float(np.abs(means - initial_state(dataset, config).scene.params.gaussians.means).max()) > 0.01
    for view, other in zip(views, large_views, strict=True):
        assert float(np.std(view.images.welllit)) > 0.01
        for image, expected in zip(jax.tree.leaves(other.images), jax.tree.leaves(view.images), strict=True):
            assert float(np.abs(image - expected).mean()) < 2e-4
        assert float(np.abs(other.depth / factor - view.depth).mean()) < 2e-3


@pytest.mark.slow
def test_in_world_units_the_images_depend_on_the_size():
    dataset, config = make_dataset(), configure("world")
    views = [trained(scaled(dataset, factor), config)[1][-1].images.lowlight for factor in (1.0, 1000.0)]
    assert float(np.abs(views[0] - views[1]).max()) > 4e-3


def test_a_camera_on_a_tripod_trains():
    dataset, config = make_dataset(), configure("depth")
    cameras = dataset.train.cameras
    still = cameras._replace(viewmat=np.repeat(cameras.viewmat[:1], len(cameras.time), axis=0))
    split = dataclasses.replace(dataset.train, cameras=still)
    dataset = dataclasses.replace(dataset, train=split, test=split)
    before = initial_state(dataset, config).scene
    after = trained(dataset, config)[0]
    alive = np.asarray(before.alive)
    moved = np.abs(np.asarray(after.params.gaussians.means - before.params.gaussians.means))[alive]
    assert float(before.extent) == pytest.approx(0.25 * np.median(dataset.points[:, 2]), rel=1e-6)
    assert np.median(moved) > 1e-3
