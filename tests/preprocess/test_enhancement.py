"""Frames brightened before training: brighter, in range, held-out ones unchanged; Zero-DCE by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_training import make_dataset

from l2dgs_jax.data.color import MID_GREY
from l2dgs_jax.data.dataset import Source
from l2dgs_jax.preprocess import zero_dce
from l2dgs_jax.preprocess.enhancement import enhanced


@pytest.fixture
def dataset():
    return dataclasses.replace(make_dataset(), source=Source("tiny", 1, "auto", "auto", 4.0))


@pytest.mark.parametrize("method", ["gamma", "clahe", "zero-dce"])
def test_training_frames_are_brightened_and_held_out_ones_unchanged(dataset, method, monkeypatch):
    monkeypatch.setattr(zero_dce, "STEPS", 3)
    monkeypatch.setattr(zero_dce, "RATES", (1e-2, 1e-2))
    bright = enhanced(dataset, method)
    images = bright.train.images
    assert images.dtype == dataset.train.images.dtype
    assert images.shape == dataset.train.images.shape
    assert images.min() >= 0
    assert images.max() <= 1
    assert images.mean() > 1.2 * dataset.train.images.mean()
    assert bright.test is dataset.test
    assert bright.source.settings["enhance"] == method
    assert enhanced(dataset, "none") is dataset


def test_zero_dce_learns_nothing_from_pixels_that_are_not_valid(dataset, monkeypatch):
    monkeypatch.setattr(zero_dce, "STEPS", 2)
    split = dataset.train
    valid = np.ones(split.images.shape[:3], bool)
    valid[:, :, :5] = False
    nets = []
    for fill in (0, 1):
        images = np.where(valid[..., None], split.images, fill).astype(split.images.dtype)
        nets.append(zero_dce.learn(dataclasses.replace(split, images=images, valid=valid), 0))
    jax.tree.map(np.testing.assert_array_equal, *nets)


def test_gamma_brings_uniform_frames_to_mid_grey(dataset):
    flat = dataclasses.replace(dataset.train, images=np.full_like(dataset.train.images, 0.05))
    images = enhanced(dataclasses.replace(dataset, train=flat), "gamma").train.images
    np.testing.assert_allclose(images, MID_GREY, rtol=2e-3)


def test_zero_dce_has_the_parameters_and_the_curve_of_its_paper():
    net = zero_dce.init(jax.random.key(0))
    assert sum(leaf.size for leaf in jax.tree.leaves(net)) == 79_416
    images = jnp.asarray(np.random.default_rng(0).uniform(0, 0.3, (1, 4, 5, 3)))
    parameters = np.asarray(zero_dce.curves(net, images)).reshape(1, 4, 5, 3, 8)
    expected = np.asarray(images)
    for n in range(8):  # LE_n = LE_{n-1} + A_n LE_{n-1} (1 - LE_{n-1})
        expected = expected + parameters[..., n] * expected * (1 - expected)
    np.testing.assert_allclose(zero_dce.brighten(net, images), expected, rtol=1e-12)


def test_the_objective_of_zero_dce_matches_its_terms_in_numpy():
    net = zero_dce.init(jax.random.key(0))
    images = jnp.asarray(np.random.default_rng(0).uniform(0, 0.4, (2, 16, 16, 3)))
    bright, curves = (np.asarray(f(net, images)) for f in (zero_dce.brighten, zero_dce.curves))
    blocks = (bright - images).mean(-1).reshape(2, 4, 4, 4, 4).mean((2, 4))
    steps = [[np.square(np.diff(x, axis=axis)) for axis in (1, 2)] for x in (blocks, curves)]
    spatial = 2 * sum(x.mean() for x in steps[0])  # a step is one of both its blocks
    smoothness = 2 * sum(x.sum(-1).mean() for x in steps[1])
    exposure = np.square(bright.mean((1, 2, 3)) - 0.6).mean()
    red, green, blue = bright.mean((1, 2)).T
    color = np.mean((red - green) ** 2 + (red - blue) ** 2 + (green - blue) ** 2)
    expected = 1 * spatial + 10 * exposure + 5 * color + 200 * smoothness
    np.testing.assert_allclose(zero_dce.loss(net, images), expected, rtol=1e-12)
    assert min(spatial, smoothness) > 1e-9 * expected  # or a mistake in them would not show
