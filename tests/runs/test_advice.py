"""Warnings of `train` about scenes that do not suit their settings."""

import dataclasses

import numpy as np
import pytest
from tiny_training import make_dataset, tiny

from l2dgs_jax.config import DensityConfig
from l2dgs_jax.runs.advice import FEW_FRAMES, FEW_POINTS, misfit

GROWING, FIXED = DensityConfig(start=1, stop=100), DensityConfig(start=1, stop=0)


def dataset_of(frames=FEW_FRAMES, points=FEW_POINTS, size=(400, 225)):
    dataset = make_dataset()
    train = dataclasses.replace(dataset.train, names=tuple(map(str, range(frames))))
    return dataclasses.replace(dataset, train=train, points=np.zeros((points, 3)), width=size[0], height=size[1])


def test_a_scene_that_suits_its_settings_gives_no_warning():
    assert misfit(dataset_of(), tiny(density=FIXED)) is None


@pytest.mark.parametrize(
    ("dataset", "density", "words"),
    [
        (dataset_of(size=(1920, 1080)), GROWING, ["1920x1080", "23 times", "--downscale 3"]),
        (dataset_of(frames=5), GROWING, ["5 frames"]),
        (dataset_of(points=20), FIXED, ["20 points", "--density.stop"]),
        (dataset_of(), dataclasses.replace(GROWING, max_gaussians=300), ["of 500 points only 300", "--density.max"]),
    ],
)
def test_a_misfit_gives_a_warning_of_one_line(dataset, density, words):
    warning = misfit(dataset, tiny(density=density))
    assert all(word in warning for word in words)
    assert "\n" not in warning


def test_few_points_give_no_warning_if_gaussians_are_added():
    assert misfit(dataset_of(points=20), tiny(density=GROWING)) is None
    config = tiny(density=FIXED)
    surfaces = dataclasses.replace(config, model=dataclasses.replace(config.model, surfaces=True))
    assert misfit(dataset_of(points=20), surfaces) is None


def test_a_camera_that_stands_still_needs_another_unit_than_that_of_its_path():
    moving, config = make_dataset(), tiny("paper")
    train = moving.train
    viewmat = train.cameras.viewmat[:1].repeat(len(train.names), 0)
    still = dataclasses.replace(
        moving, train=dataclasses.replace(train, cameras=train.cameras._replace(viewmat=viewmat))
    )
    assert "--model.unit depth" in misfit(still, config)
    assert "--model.unit" not in misfit(moving, config)
    assert "--model.unit" not in misfit(still, tiny())


def test_the_suggested_downscale_multiplies_the_one_in_use():
    assert "--downscale 4" in misfit(dataset_of(size=(960, 540)), tiny(density=FIXED, downscale=2))
