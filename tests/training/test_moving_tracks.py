"""Where tracks of moving things begin and end; `test_seeds.py` has those of a whole clip."""

import dataclasses

import numpy as np
import pytest
from moving_squares import FRAMES, SIDE, K, backdrop, seen

from l2dgs_jax.cameras.geometry import project_points
from l2dgs_jax.training.backdrop import DEPTH_CELL, Backdrop, Cameras, Depths
from l2dgs_jax.training.flows import Flows
from l2dgs_jax.training.moving_tracks import from_rest, surely_moving, until_rest
from l2dgs_jax.training.tracks import Tracks, by_track

SPLIT, ALL = seen()
OBJECT, SHADOW, _ = range(3)  # tracks of squares that move by four pixels a frame
NEXT = np.minimum(np.arange(FRAMES) + 1, FRAMES - 1)


def only(number, tracks=ALL):
    return Tracks(*(x[tracks.numbers == number] for x in tracks))


def resting(last, first=0):
    """The clip with all squares at rest until the frame `first` and from `last` on, and the tracks of their centres."""
    shown = np.clip(np.arange(FRAMES), first, last)
    split = dataclasses.replace(SPLIT, images=SPLIT.images[shown])
    places = np.concatenate([places[shown] for places in by_track(ALL, ALL.pixels)])
    return split, ALL._replace(pixels=places)


def until(begin, split=SPLIT, stuck=7):
    """Frames that remain of the object's track, if it begins in a frame and is later stuck on the background."""
    track = only(OBJECT)
    pixels = np.where((track.frames >= stuck)[:, None], track.pixels[stuck - 2], track.pixels)
    lost = Tracks(*(x[begin:] for x in track._replace(pixels=pixels)))
    return until_rest(lost, split, backdrop(split)).frames.tolist()


@pytest.mark.parametrize(("begin", "remain"), [(0, [0, 1, 2, 3, 4, 5, 6]), (4, [4, 5, 6])])
def test_a_track_ends_where_it_shows_the_background_at_rest(begin, remain):
    assert until(begin)[: len(remain)] == remain
    assert len(until(begin)) <= len(remain) + 1  # the step away from the object is a motion, too


def test_a_track_that_has_ended_does_not_go_on_where_something_passes():
    images = np.array(SPLIT.images)
    images[10] = images[5]
    assert max(until(0, dataclasses.replace(SPLIT, images=images))) <= 7


def test_of_tracks_that_are_almost_only_background_nothing_remains():
    track = only(OBJECT)
    standing = track._replace(pixels=np.tile(track.pixels[5], (FRAMES, 1)))
    assert not len(until_rest(Tracks(*(x[8:] for x in standing)), SPLIT, backdrop(SPLIT)).frames)


def test_tracks_go_on_while_their_objects_rest():
    split, tracks = resting(last=6)
    ended = until_rest(only(OBJECT, tracks), split, backdrop(split))
    assert ended.frames.tolist() == list(range(FRAMES))


def test_shadows_go_on_until_the_last_frame():
    unsure = ALL._replace(moves=np.zeros(len(ALL.frames), bool))
    ended = until_rest(unsure, SPLIT, backdrop(SPLIT))
    assert only(SHADOW, ended).frames.tolist() == list(range(FRAMES))


def flows(rest):
    """Flow that is zero before the frame `rest`, and that of the squares afterwards."""
    displacements = np.zeros((FRAMES, 2, SIDE, SIDE, 2), np.float16)
    displacements[rest:, 0, ..., 0], displacements[rest:, 1, ..., 0] = 4, -4
    return Flows(NEXT, displacements)


def set_off(first_step):
    """The object's track from frame 6 on, where it is set off by a step of so many pixels, and all that flow finds."""
    split, tracks = resting(last=FRAMES - 1, first=6)
    begun = Tracks(*(x[6:] for x in only(OBJECT, tracks)))
    pixels = begun.pixels.copy()
    pixels[0, 0] = pixels[1, 0] - first_step
    return from_rest(begun._replace(pixels=pixels), flows(6), split, backdrop(split))


def test_a_track_that_sets_off_slowly_is_followed_back_to_the_first_frame():
    followed = set_off(1.2)
    assert followed.frames.tolist() == list(range(FRAMES))
    assert not followed.moves[:6].any()
    np.testing.assert_array_equal(followed.pixels[:6], np.tile(followed.pixels[6], (6, 1)))


def test_a_track_that_is_fast_at_first_is_not_followed_back():
    assert set_off(4.0).frames.tolist() == list(range(6, FRAMES))


def test_a_track_is_followed_back_only_as_far_as_it_differs_from_the_background():
    split, tracks = resting(last=FRAMES - 1, first=6)
    images = np.array(split.images)
    images[3] = SPLIT.images[-1]  # in which the object is elsewhere
    split = dataclasses.replace(split, images=images)
    begun = Tracks(*(x[6:] for x in only(OBJECT, tracks)))
    begun.pixels[0, 0] = begun.pixels[1, 0] - 1.2
    followed = from_rest(begun, flows(6), split, backdrop(split))
    assert followed.frames.tolist() == list(range(4, FRAMES))


@pytest.mark.parametrize("step", [0.1, 0.3])
def test_what_moves_is_found_if_the_camera_walks_past_static_things(step):
    frames = np.arange(FRAMES * 2)
    viewmat = np.tile(np.eye(4), (len(frames), 1, 1))
    viewmat[:, 2, 3] = -step * frames
    Ks = np.tile(K, (len(frames), 1, 1))
    person = np.stack([0.03 * frames, 0 * frames, 2 + step * frames], axis=-1)  # always two units ahead
    pixels, _ = project_points(person, viewmat, Ks)
    track = Tracks(0 * frames, frames, pixels, np.ones(len(frames), bool))
    cells = SIDE // DEPTH_CELL
    candidates = np.array([3.0, 4.0, 6.0, 10.0], np.float32)[:, None, None, None]
    depths = Depths(np.broadcast_to(candidates, (4, len(frames), cells, cells)), None)
    cameras = Cameras(viewmat, Ks, frames / len(frames))
    assert len(surely_moving(track, Backdrop(cameras, depths, None), most=10).frames) == len(frames)
