"""The warping error of videos with known motion."""

import numpy as np
import pytest

from l2dgs_jax.metrics import warping_error_map

SHIFT = (3, 2)  # columns and rows that everything moves by


def video(brighter=0.0):
    """Two frames of a plane that moves, and its flow where it stays in the picture."""
    plane = np.random.default_rng(0).uniform(0.2, 0.7, (30, 40, 3)).astype(np.float32)
    frame, following = plane[5:25, 5:35], plane[5 - SHIFT[1] : 25 - SHIFT[1], 5 - SHIFT[0] : 35 - SHIFT[0]]
    flow = np.full((20, 30, 2), np.nan, np.float32)
    flow[: -SHIFT[1], : -SHIFT[0]] = SHIFT
    return frame, following + np.float32(brighter), flow


@pytest.mark.parametrize("brighter", [0.0, 0.1])
def test_motion_along_the_flow_has_only_the_error_of_its_flicker(brighter):
    error = warping_error_map(*video(brighter))
    np.testing.assert_array_equal(np.isfinite(error), np.isfinite(video()[2]).all(-1))
    np.testing.assert_allclose(error[np.isfinite(error)], brighter**2, atol=1e-6)


def test_motion_that_differs_from_the_flow_has_an_error():
    frame, following, flow = video()
    assert np.nanmean(warping_error_map(frame, following, 0 * flow)) > 0.01


def test_nan_pixels_have_no_error():
    frame, following, flow = video()
    frame, following = frame.copy(), following.copy()
    frame[0, 0] = following[10, 12] = np.nan
    error = warping_error_map(frame, following, flow)
    assert np.isnan(error[0, 0])
    assert np.isnan(error[10 - SHIFT[1], 12 - SHIFT[0]])
    assert np.isfinite(error[5, 5])
