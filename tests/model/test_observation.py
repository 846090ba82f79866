"""Colours and exposures observed at the points."""

import numpy as np
import pytest
from cloud import POINTS, cameras

from l2dgs_jax.model import observation


def test_observed_colors_are_those_of_the_pixels_that_points_project_to():
    images = np.random.default_rng(3).uniform(size=(4, 12, 16, 3))
    images[1:] = images[:1]
    same_camera = cameras([[0, 0, 0]] * 4)
    point_in_pixel = lambda column, row, z: [(column + 0.5 - 8) / 10 * z, (row + 0.5 - 6) / 10 * z, z]
    points = np.array([point_in_pixel(3, 5, 2.0), point_in_pixel(15, 11, 3.0), [0, 0, -1], [100, 0, 1]])
    colors = observation.observed_colors(points, same_camera, images)
    np.testing.assert_allclose(colors[0], images[0, 5, 3], rtol=1e-6)
    np.testing.assert_allclose(colors[1], images[0, 11, 15], rtol=1e-6)
    np.testing.assert_allclose(colors[2:], np.tile(images.mean((0, 1, 2)), (2, 1)), rtol=1e-6)


def test_observed_colors_take_the_median_over_frames():
    images = np.zeros((3, 12, 16, 3))
    images[:] = np.array([0.1, 0.2, 0.9])[:, None, None, None]
    colors = observation.observed_colors(np.array([[0, 0, 2.0]]), cameras([[0, 0, 0]] * 3), images)
    np.testing.assert_allclose(colors, 0.2, rtol=1e-6)


@pytest.mark.parametrize("at_once", [observation.VALUES_IN_MEMORY, 40])
def test_observed_colors_are_the_same_when_few_are_held_at_once(monkeypatch, at_once):
    rng = np.random.default_rng(4)
    images, valid = rng.uniform(size=(7, 12, 16, 3)).astype(np.float16), rng.random((7, 12, 16)) < 0.6
    spread = cameras(rng.uniform([-2, -1, -2], [2, 1, 3], (7, 3)))
    monkeypatch.setattr(observation, "VALUES_IN_MEMORY", at_once)
    colors = observation.observed_colors(POINTS, spread, images, valid)

    local = np.einsum("fij,pj->fpi", spread.viewmat[:, :3, :3], POINTS) + spread.viewmat[:, None, :3, 3]
    pixels = np.floor(np.einsum("fij,fpj->fpi", spread.K, local) / np.where(local[..., 2:] > 0, local[..., 2:], np.inf))
    mean = images.mean((0, 1, 2), np.float64, where=valid[..., None]).astype(np.float32)
    seen_more_than_once = 0
    for point, color in enumerate(colors):
        seen = [
            images[frame, int(row), int(column)].astype(np.float32)
            for frame, (column, row, _) in enumerate(pixels[:, point])
            if local[frame, point, 2] > 0
            and (0 <= column < 16 and 0 <= row < 12)
            and valid[frame, int(row), int(column)]
        ]
        seen_more_than_once += len(seen) > 1
        np.testing.assert_array_equal(color, np.median(seen, axis=0) if seen else mean)
    assert 5 < seen_more_than_once < len(POINTS)


def test_no_points_have_no_colors():
    images = np.full((3, 12, 16, 3), 0.2)
    assert observation.observed_colors(np.zeros((0, 3)), cameras([[0, 0, 0]] * 3), images).shape == (0, 3)


def wall(frames, gains):
    """A textured wall that the camera sees from the same place in every frame, exposed differently."""
    texture = np.random.default_rng(5).uniform(0.1, 0.4, (12, 16, 3))
    return np.exp(gains)[:, None, None] * np.tile(texture, (frames, 1, 1, 1))


def test_exposures_are_the_gains_of_the_frames():
    rng = np.random.default_rng(6)
    gains = rng.uniform(-0.3, 0.3, (9, 3))
    images = wall(9, gains)
    images[:, 2:5, 3:7] = rng.uniform(0.1, 0.4, (9, 3, 4, 3))  # something else moves
    found = observation.exposures(POINTS, cameras([[0, 0, 0]] * 9), images)
    np.testing.assert_allclose(found, gains - gains.mean(0), atol=0.02)
    np.testing.assert_allclose(found.mean(0), 0, atol=1e-6)


def test_points_that_are_hidden_tell_nothing_of_the_exposure():
    rng = np.random.default_rng(7)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-11.75, 12, 0.5), np.arange(-2.25, 2.5, 0.5)))
    wall, board = np.stack([x, y, np.full_like(x, 4)], -1), np.stack([x / 4, y / 4, np.full_like(x, 1)], -1)
    board = board[(board[:, 0] > 0.3) & (board[:, 0] < 1.7)]  # dark, and before most of what later cameras see
    spread = cameras(np.stack([np.linspace(-0.5, 1, 9), np.zeros(9), np.zeros(9)], -1))
    images = np.empty((9, 12, 16, 3))
    for image, centre in zip(images, -spread.viewmat[:, 0, 3], strict=True):
        at = (np.arange(16) + 0.5 - 8) / 10 + centre
        image[:] = np.where((at > 0.3) & (at < 1.7), 0.1, 0.4)[None, :, None]
    gains = rng.uniform(-0.1, 0.1, (9, 1)).repeat(3, 1)
    found = observation.exposures(np.concatenate([wall, board]), spread, images * np.exp(gains)[:, None, None])
    np.testing.assert_allclose(found, gains - gains.mean(0), atol=0.02)


def test_frames_without_observations_have_no_exposure_gain():
    images, valid = wall(4, np.full((4, 3), 0.1)), np.ones((4, 12, 16), bool)
    images[2] *= 1.4
    valid[2] = False
    np.testing.assert_allclose(observation.exposures(POINTS, cameras([[0, 0, 0]] * 4), images, valid), 0, atol=1e-6)
    assert not observation.exposures(POINTS - [0, 0, 9], cameras([[0, 0, 0]] * 4), images).any()
