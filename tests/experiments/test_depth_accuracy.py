"""Stereo between the two cameras of a scene, and the errors of seeds by it."""

import json

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments.markdown import percentages
from experiments.quality import depth_accuracy
from l2dgs_jax.data import Split
from l2dgs_jax.data.dataset import Dataset
from l2dgs_jax.model.initialisation import Seeds
from l2dgs_jax.types import Camera

HEIGHT, WIDTH, FOCAL, DEPTH, DISPARITY = 48, 64, 60.0, 2.0, 6
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float32)
TIMES = np.array([0.0, 0.5, 1.0], np.float32)


@pytest.fixture(scope="module")
def dataset():
    """A wall at rest; the second camera, to the right, sees it at the first and the last instant."""
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.uniform(0, 1, (HEIGHT, WIDTH + DISPARITY, 3)), (0, 0), 1).astype(np.float32)

    def split(times, offset):
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[0, 3] = -offset * DISPARITY * DEPTH / FOCAL
        frames, count = image[:, offset * DISPARITY :][:, :WIDTH], len(times)
        cameras = Camera(np.tile(viewmat, (count, 1, 1)), np.tile(K, (count, 1, 1)), times)
        images, masks = np.tile(frames, (count, 1, 1, 1)), np.ones((count, HEIGHT, WIDTH), bool)
        masks[:, :, : WIDTH // 2] = False
        return Split(tuple(map(str, times)), cameras, 0.2 * images, images, masks)

    points = rng.uniform((-0.5, -0.5, 1), (0.5, 0.5, 4), (200, 3)).astype(np.float32)
    return Dataset("wall", WIDTH, HEIGHT, split(TIMES, 0), split(TIMES[::2], 1), points)


def test_stereo_finds_the_distance_of_a_wall_at_the_instants_that_both_cameras_see(dataset):
    found = depth_accuracy.stereo(dataset)
    assert list(found) == [0, 2]
    for depth in found.values():
        inside = depth[4:-4, DISPARITY + 4 : -4]
        assert np.isfinite(inside).mean() > 0.9
        assert_allclose(inside[np.isfinite(inside)], DEPTH, rtol=0.02)


def test_errors_are_those_of_seeds_that_are_alive_and_lie_on_what_moves(dataset):
    points = 2.2 * np.array([[0.1, 0, 1], [0.2, 0.1, 1], [-0.2, 0, 1]], np.float32)
    paths = np.zeros((3, 4, 3), np.float32)
    lifetimes = np.array([[0, 1], [0, 0.4], [0, 1]], np.float32)
    seeds = Seeds(points, np.zeros((3, 3), np.float32), np.ones(3, np.float32), paths, lifetimes)
    first, last = depth_accuracy.errors(seeds, dataset.train, depth_accuracy.stereo(dataset))
    assert_allclose(first, np.log([1.1, 1.1]), atol=0.02)
    assert_allclose(last, np.log([1.1]), atol=0.02)
    assert depth_accuracy.summary(np.array([0.1, -0.2, -0.3])) == "20.0% (-20.0%)"


def test_the_numbers_are_the_medians_of_the_clip_and_of_its_end(dataset, tmp_path, monkeypatch):
    ends = [np.full(3, 0.1)] * 5 + [np.full(3, -0.3)]
    monkeypatch.setattr(depth_accuracy, "load_dataset", lambda *_: dataset)
    monkeypatch.setattr(depth_accuracy, "find_seeds", lambda *_, **__: None)
    monkeypatch.setattr(depth_accuracy, "errors", lambda *_: ends)
    depth_accuracy.main(["here/wall", "--json", str(tmp_path / "found.json")])
    found = json.loads((tmp_path / "found.json").read_text())
    assert found == {"wall": {"whole clip": 0.1, "last sixth": 0.3}}
    assert percentages(found).splitlines()[-1] == "| wall | 10.0% | 30.0% |"
