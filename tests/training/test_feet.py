"""The lowest parts of moving things, and where they end."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from l2dgs_jax.training.feet import BELOW, BESIDE, REACH, STEP, find_feet, find_soles, just_below
from l2dgs_jax.training.tracks import Tracks

HEIGHT = 100


def observations(pixels, frames=0):
    pixels = np.array(pixels, float)
    count = len(pixels)
    return Tracks(np.arange(count), np.broadcast_to(frames, count), pixels, np.ones(count, bool))


def every(tracks):
    return np.ones(len(tracks.frames), bool)


def test_what_is_just_below_is_near_in_both_directions():
    (low, high), x = BELOW, 50.0
    places = [(x, 50), (x, 50 + high - 0.1), (x + BESIDE - 0.1, 50 + low + 0.1), (x, 50 + low - 0.1)]
    tracks = observations([*places, (x + BESIDE + 0.1, 55), (x, 50 + high + 2)])
    pairs = set(map(tuple, just_below(tracks, every(tracks)).T.tolist()))
    assert pairs >= {(0, 1), (0, 2), (1, 5)}
    assert not {(0, 3), (0, 4), (0, 5)} & pairs


def test_things_of_other_frames_and_of_the_background_are_not_below():
    tracks = observations([(50, 50), (50, 55), (50, 55)], frames=[0, 1, 0])
    assert just_below(tracks, np.array([True, True, False])).size == 0
    assert just_below(tracks, np.array([False, True, True])).size == 0
    assert just_below(tracks, np.zeros(3, bool)).shape == (2, 0)


def feet_of(tracks, foreground, height=HEIGHT):
    return find_feet(tracks, foreground, just_below(tracks, foreground), height).tolist()


def test_feet_have_nothing_below_and_are_not_at_the_lower_border():
    column = observations([(50, 20), (50, 26), (50, 32), (80, 95)])
    assert feet_of(column, every(column)) == [False, False, True, False]
    assert feet_of(column, every(column), 200)[3]


def test_a_shadow_is_no_foot_and_what_stands_above_it_is_one():
    column = observations([(50, 20), (50, 26), (50, 32)])
    assert feet_of(column, np.array([True, True, False])) == [False, True, False]


@pytest.mark.parametrize("end", [52.0, 57.0, 68.0])
def test_a_foot_ends_where_the_background_begins(end):
    feet = np.array([[50.0, 50.0], [70.0, end]])
    soles = find_soles(np.zeros(2, int), feet, lambda _, pixels: pixels[:, 1] > end, 200.0, HEIGHT)
    assert_allclose(soles[:, 0], feet[:, 0])
    assert end - STEP < soles[0, 1] <= end
    assert_allclose(soles[1], feet[1])


@pytest.mark.parametrize("row", [50.0, 90.0])
def test_a_foot_without_an_end_in_view_keeps_its_place(row):
    asked = []

    def is_background(frames, pixels):
        assert len(frames) == len(pixels)
        asked.extend(pixels[:, 1])
        return np.zeros(len(frames), bool)

    feet = np.array([[50.0, row]])
    assert_allclose(find_soles(np.zeros(1, int), feet, is_background, 200.0, HEIGHT), feet)
    assert max(asked) < min(HEIGHT, row + REACH * 200 + 1e-6)


def test_there_may_be_no_feet():
    is_background = lambda frames, _: np.zeros(len(frames), bool)
    assert find_soles(np.zeros(0, int), np.zeros((0, 2)), is_background, 200.0, HEIGHT).shape == (0, 2)


def test_frames_may_be_tiny():
    feet = np.array([[5.0, 5.0]])
    assert_allclose(find_soles(np.zeros(1, int), feet, lambda frames, _: np.ones(len(frames), bool), 3.0, 12), feet)
