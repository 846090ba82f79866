"""The level that a split's frames are said to have."""

import dataclasses

import numpy as np
import pytest

from l2dgs_jax.data.dataset import Split
from l2dgs_jax.types import Camera

CAMERAS = Camera(np.tile(np.eye(4), (3, 1, 1)), np.tile(np.eye(3), (3, 1, 1)), np.linspace(0, 1, 3))


def test_lamps_and_pixels_that_are_not_valid_do_not_count_in_the_mean_level():
    images = np.random.default_rng(0).uniform(0, 0.3, (3, 5, 7, 3)).astype(np.float16)
    dark = images[:, :, 2:].astype(np.float64).mean()
    images[:, 1, :2] = [1, 0.7, 0.2]  # of a lamp, one channel is enough
    images[:, 2:, :2] = 0.9
    valid = np.ones((3, 5, 7), bool)
    valid[:, 0, :2] = valid[:, 2:, :2] = False
    split = Split(("a", "b", "c"), CAMERAS, images, valid=valid)
    assert split.mean_level == pytest.approx(dark)
    assert dataclasses.replace(split, valid=None).mean_level > dark


def test_frames_that_are_saturated_everywhere_have_level_one():
    assert Split(("a", "b", "c"), CAMERAS, np.ones((3, 5, 7, 3))).mean_level == 1
