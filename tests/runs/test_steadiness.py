"""Steadiness of videos with known motion."""

import dataclasses

import cv2
import numpy as np
import pytest

from l2dgs_jax.data.dataset import Split
from l2dgs_jax.runs.steadiness import steadiness
from l2dgs_jax.types import Camera

FRAMES, HEIGHT, WIDTH = 4, 64, 96


@pytest.fixture(scope="module")
def split():
    """A textured plane that moves a pixel to the right from frame to frame, seen by a static camera."""
    rng = np.random.default_rng(0)
    plane = cv2.GaussianBlur(rng.uniform(0, 1, (HEIGHT, WIDTH + FRAMES, 3)), (0, 0), 2)
    plane = 0.2 + 0.5 * (plane - plane.min()) / np.ptp(plane)
    truth = np.stack([plane[:, FRAMES - k : FRAMES - k + WIDTH] for k in range(FRAMES)]).astype(np.float16)
    viewmats = np.broadcast_to(np.eye(4, dtype=np.float32), (FRAMES, 4, 4))
    cameras = Camera(viewmats, np.broadcast_to(np.eye(3, dtype=np.float32), (FRAMES, 3, 3)), np.linspace(0, 1, FRAMES))
    masks = np.zeros((FRAMES, HEIGHT, WIDTH), bool)
    masks[:, :, : WIDTH // 2] = True
    return Split(tuple("abcd"), cameras, truth / 10, truth, masks)


def test_a_video_equal_to_the_truth_is_as_steady_as_it(split):
    found = steadiness(split.welllit, split, 1.0)
    assert (found["flow"], found["pairs"]) == ("truth", FRAMES - 1)
    for region in ("overall", "dynamic", "static"):
        scores = found["regions"][region]
        assert scores["warping_error"] == scores["warping_error_gain"] == scores["warping_error_truth"] < 1e-4
    areas = {region: scores["area"] for region, scores in found["regions"].items()}
    assert areas["overall"] > 0.8
    assert areas["overall"] == pytest.approx(areas["dynamic"] + areas["static"])


def test_flicker_raises_the_warping_error_of_its_region_only(split):
    flicker = split.welllit.copy()
    flicker[1::2, :, WIDTH // 2 :] += 0.1
    regions = steadiness(flicker / 2, split, 2.0)["regions"]
    assert regions["static"]["warping_error_gain"] == pytest.approx(0.01, rel=0.1)
    assert regions["static"]["warping_error"] == pytest.approx(0.01 / 4, rel=0.1)
    assert regions["dynamic"]["warping_error_gain"] < 1e-3
    assert regions["static"]["warping_error_truth"] < 1e-4


def test_without_truth_flow_is_computed_from_the_input(split):
    found = steadiness(split.welllit, dataclasses.replace(split, welllit=None), None)
    assert found["flow"] == "input"
    assert found["regions"]["overall"].keys() == {"warping_error", "area"}
    assert found["regions"]["overall"]["warping_error"] < 1e-4


def test_a_single_view_has_no_pairs(split):
    single = Split(("a",), Camera(*(x[:1] for x in split.cameras)), split.images[:1], split.welllit[:1])
    assert steadiness(single.welllit, single, 1.0) == {"flow": "truth", "pairs": 0, "regions": {}}


def test_invalid_pixels_are_left_out(split):
    valid = np.ones((FRAMES, HEIGHT, WIDTH), bool)
    valid[:, :, WIDTH // 2 :] = False
    flicker = split.welllit.copy()
    flicker[1::2, :, WIDTH // 2 :] += 0.1
    found = steadiness(flicker, dataclasses.replace(split, valid=valid), 1.0)["regions"]
    assert found["overall"]["warping_error"] < 1e-4
    assert found["overall"]["area"] < 0.5
    assert "static" not in found
