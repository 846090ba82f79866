"""FLIP compared with its authors' program, if installed, and properties that can be checked without it."""

import cv2
import numpy as np
import pytest
from skimage.color import rgb2lab

from l2dgs_jax.metrics.flip import flip_map


def pair(seed, height=41, width=60):
    rng = np.random.default_rng(seed)
    smooth = cv2.GaussianBlur(rng.uniform(size=(height, width, 3)), (0, 0), 1 + seed)
    truth = (smooth - smooth.min()) / np.ptp(smooth)
    return np.clip(truth + rng.normal(0, 0.15, truth.shape), 0, 1).astype(np.float32), truth.astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_flip_matches_its_authors_program(seed):
    reference = pytest.importorskip("flip_evaluator")
    prediction, truth = pair(seed)
    expected, _, _ = reference.evaluate(truth, prediction, "LDR", applyMagma=False)
    np.testing.assert_allclose(flip_map(prediction, truth), expected[..., 0], atol=2e-5)


def test_flip_is_a_symmetric_difference_between_zero_and_one():
    prediction, truth = pair(2)
    error = flip_map(prediction, truth)
    np.testing.assert_allclose(error, flip_map(truth, prediction), atol=1e-6)
    assert not flip_map(truth, truth).any()
    assert 0 <= error.min() < error.max() <= 1
    assert flip_map((prediction + truth) / 2, truth).mean() < error.mean()


def hunt(color):
    lightness, a, b = rgb2lab(np.array(color, float))
    return np.array([lightness, 0.01 * lightness * a, 0.01 * lightness * b])


def hyab(first, second):
    lightness, *chroma = hunt(first) - hunt(second)
    return abs(lightness) + np.hypot(*chroma)


@pytest.mark.parametrize(
    ("first", "second"), [((0, 0, 0), (1, 1, 1)), ((0, 1, 0), (0, 0, 1)), ((0.5, 0.4, 0.3), (0.5, 0.42, 0.3))], ids=str
)
def test_flip_of_flat_colours_is_their_remapped_hyab_distance(first, second):
    largest = hyab((0, 1, 0), (0, 0, 1)) ** 0.7
    error, knee = hyab(first, second) ** 0.7, 0.4 * largest
    expected = 0.95 * error / knee if error < knee else 0.95 + 0.05 * (error - knee) / (largest - knee)
    found = flip_map(*(np.broadcast_to(np.array(color, float), (9, 12, 3)) for color in (first, second)))
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_details_too_fine_to_be_resolved_count_less():
    columns = np.indices((48, 48))[1]
    grey = np.full((48, 48, 3), 0.5)
    stripes = lambda width: grey + 0.2 * (-1.0) ** (columns // width)[..., None]
    fine, coarse = (flip_map(stripes(width), grey)[12:-12, 12:-12].mean() for width in (1, 12))
    assert fine < 0.5 * coarse
