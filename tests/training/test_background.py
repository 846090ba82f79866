"""What shows the background is told from objects by its colours."""

import dataclasses

import numpy as np
import pytest

from l2dgs_jax.data.color import linear_to_srgb
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.training import background
from l2dgs_jax.training.backdrop import DEPTH_CELL, Backdrop, Cameras, Depths
from l2dgs_jax.training.background import looks_like_background
from l2dgs_jax.training.tracks import Tracks, share_in_track
from l2dgs_jax.types import Camera

FRAMES, SIDE, DEPTH = 12, 64, 2.0
K = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
COLOUR = np.array([0.03, 0.09, 0.02])
ROWS = {"object": 12, "shadow": 32, "bright": 52}  # of squares that move to the right over a wall


def wall():
    """Light of the wall that cameras at rest see."""
    rng = np.random.default_rng(0)
    return np.repeat(np.repeat(rng.uniform(0.02, 0.1, (8, 8, 3)), 8, 0), 8, 1)


def seen(squares=(COLOUR, 0.6, 1.5)):
    """Frames of the wall with three squares, the first of its own colour, the others changing the light; and tracks."""
    light = np.tile(wall(), (FRAMES, 1, 1, 1))
    numbers, frames, pixels = [], [], []
    for number, (row, square) in enumerate(zip(ROWS.values(), squares, strict=True)):
        for frame in range(FRAMES):
            column = 8 + 4 * frame
            part = light[frame, row - 5 : row + 6, column - 5 : column + 6]
            part[:] = part * square if np.ndim(square) == 0 else square
            numbers.append(number), frames.append(frame), pixels.append((column + 0.5, row + 0.5))
    cameras = Camera(
        np.tile(np.eye(4, dtype=np.float32), (FRAMES, 1, 1)),
        np.tile(K.astype(np.float32), (FRAMES, 1, 1)),
        np.linspace(0, 1, FRAMES, dtype=np.float32),
    )
    split = Split(tuple(map(str, range(FRAMES))), cameras, linear_to_srgb(light).astype(np.float32))
    tracks = Tracks(np.array(numbers), np.array(frames), np.array(pixels), np.ones(len(frames), bool))
    return split, tracks


def backdrop(split, depth=DEPTH):
    """The wall behind everything."""
    cells = np.full((len(split.names), SIDE // DEPTH_CELL, SIDE // DEPTH_CELL), depth, np.float32)
    return Backdrop(Cameras(*(np.asarray(x, float) for x in split.cameras)), Depths(cells[None], cells), None)


def found(split, tracks, behind=None):
    """Shares of the observations that look like the background."""
    looks = looks_like_background(tracks.frames, tracks.pixels, split, behind or backdrop(split), tracks)
    return dict(zip(ROWS, share_in_track(tracks, looks)[:: len(looks) // 3].tolist(), strict=True))


def test_a_shadow_shows_the_background_but_not_an_object_nor_a_light():
    split, tracks = seen()
    shares = found(split, tracks)
    assert shares["shadow"] > 0.95
    assert shares["object"] < 0.1
    assert shares["bright"] == 0


def test_noise_is_no_colour():
    split, tracks = seen((0.1, 0.9, 1.0))
    noise = np.random.default_rng(1).normal(0, 0.02, split.images.shape).astype(np.float32)
    split = dataclasses.replace(split, images=np.clip(split.images + noise, 0, 1))
    shares = found(split, tracks)
    assert min(shares["shadow"], shares["bright"]) > 0.8
    assert shares["object"] < 0.2


def test_a_surface_of_unknown_depth_is_not_shown():
    split, tracks = seen()
    assert found(split, tracks, backdrop(split, np.nan))["shadow"] == 0


def test_a_surface_that_is_never_seen_elsewhere_is_not_shown(monkeypatch):
    monkeypatch.setattr(background, "REACH", 2 * SIDE)
    assert found(*seen())["shadow"] == 0


def test_other_pixels_than_those_of_tracks_can_be_asked_about():
    split, tracks = seen()
    pixels = np.array([[10.5, ROWS["object"] + 0.5], [60.5, ROWS["object"] + 0.5]])
    looks = looks_like_background(np.zeros(2, int), pixels, split, backdrop(split), tracks)
    assert looks.tolist() == [False, True]


def test_pixels_that_are_not_valid_do_not_tell():
    split, tracks = seen()
    valid = np.ones(split.images.shape[:3], bool)
    valid[:-2] = False
    shares = found(dataclasses.replace(split, valid=valid), tracks)
    assert shares["shadow"] == 0


@pytest.mark.parametrize("frames", [5, 1000])
def test_a_few_frames_tell_what_the_background_looks_like(frames, monkeypatch):
    monkeypatch.setattr(background, "MAX_FRAMES", frames)
    split, tracks = seen()
    assert found(split, tracks)["shadow"] > 0.95
