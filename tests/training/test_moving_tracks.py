"""Where tracks of moving things end; `test_seeds.py` has where they begin."""

import dataclasses

import numpy as np
import pytest
from moving_squares import FRAMES, backdrop, seen

from l2dgs_jax.training.moving_tracks import until_rest
from l2dgs_jax.training.tracks import Tracks

SPLIT, ALL = seen()
TRACK = Tracks(*(x[ALL.numbers == 0] for x in ALL))  # of the square that has a colour of its own


@pytest.mark.parametrize(("begin", "remain"), [(0, [0, 1, 2, 3, 4, 5, 6]), (4, [4, 5, 6]), (5, [])])
def test_a_track_ends_where_it_shows_the_background_at_rest(begin, remain):
    stays = TRACK.frames >= 7
    pixels = np.where(stays[:, None], TRACK.pixels[5], TRACK.pixels)
    lost = Tracks(*(x[begin:] for x in TRACK._replace(pixels=pixels, moves=~stays)))
    assert until_rest(lost, SPLIT, backdrop(SPLIT)).frames.tolist() == remain


def test_a_track_goes_on_while_its_object_rests():
    last = np.minimum(np.arange(FRAMES), 6)
    split = dataclasses.replace(SPLIT, images=SPLIT.images[last])
    ended = until_rest(TRACK._replace(pixels=TRACK.pixels[last], moves=np.arange(FRAMES) < 6), split, backdrop(split))
    assert ended.frames.tolist() == list(range(FRAMES))


def test_a_shadow_goes_on_while_it_moves():
    shadow = Tracks(*(x[ALL.numbers == 1] for x in ALL))
    assert until_rest(shadow, SPLIT, backdrop(SPLIT)).frames.tolist() == list(range(FRAMES))
