"""Tracks followed back in time, on flow made by hand."""

import numpy as np
import pytest

from l2dgs_jax.training.flows import Flows
from l2dgs_jax.training.tracks import SPACING, Tracks, followed_back

SIDE, PLACE = 30, np.array([10.5, 10.5])


def standing(following, shift=0.0):
    """Flow that stands still forward, and goes back by so many pixels to the right."""
    following = np.array(following)
    displacements = np.zeros((len(following), 2, SIDE, SIDE, 2), np.float16)
    displacements[:, 1, ..., 0] = shift
    return Flows(following, displacements)


def begun(frame, number=0, place=PLACE):
    """A track of one observation."""
    return Tracks(np.array([number]), np.array([frame]), np.array([place]), np.ones(1, bool))


def both(first, second):
    return Tracks(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))


def test_tracks_are_followed_to_the_first_frame():
    found = followed_back(begun(3), np.array([0]), standing([1, 2, 3, 3], shift=2.0), np.linspace(0, 1, 4))
    assert found.frames.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(found.pixels[:, 0], PLACE[0] + np.array([6, 4, 2]))
    assert not found.moves.any()


@pytest.mark.parametrize("shift", [np.nan, SIDE])
def test_they_end_where_flow_does_or_the_frame(shift):
    found = followed_back(begun(3), np.array([0]), standing([1, 2, 3, 3], shift), np.linspace(0, 1, 4))
    assert not len(found.frames)


def test_only_those_asked_for_are_followed_and_not_to_where_others_are():
    tracks = both(begun(3), begun(1, 1, PLACE + SPACING / 10))
    find = lambda numbers: followed_back(tracks, np.array(numbers), standing([1, 2, 3, 3]), np.linspace(0, 1, 4))
    assert find([0]).frames.tolist() == [2]
    assert find([1]).frames.tolist() == [0]
    assert find([0, 1]).numbers.tolist() == [0, 1]


def test_of_two_that_arrive_in_one_place_one_goes_on():
    tracks = both(begun(1), begun(1, 1, PLACE + SPACING / 10))
    assert followed_back(tracks, np.arange(2), standing([1, 2, 3, 3]), np.linspace(0, 1, 4)).numbers.tolist() == [0]


def test_with_several_cameras_a_track_has_one_observation_at_an_instant():
    following, times = [1, 2, 2, 1], np.array([0.0, 0.5, 1.0, 0.0])  # the last frame is of another camera
    passed = both(both(begun(0), begun(1)), begun(2))
    assert not len(followed_back(passed, np.array([0]), standing(following), times).frames)
    assert len(followed_back(begun(1), np.array([0]), standing(following), times).frames) == 1
