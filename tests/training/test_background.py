"""What shows the background is told from objects by its colours."""

import dataclasses

import numpy as np
import pytest
from moving_squares import ROWS, SIDE, backdrop, seen

from l2dgs_jax.training import background
from l2dgs_jax.training.background import likeness_to_background
from l2dgs_jax.training.tracks import share_in_track


def found(split, tracks, behind=None):
    """Shares of the observations that look like the background."""
    looks = likeness_to_background(tracks.frames, tracks.pixels, split, behind or backdrop(split), tracks).alike
    return dict(zip(ROWS, share_in_track(tracks, looks)[:: len(looks) // 3].tolist(), strict=True))


def test_a_shadow_shows_the_background_but_not_an_object_nor_a_light():
    split, tracks = seen()
    shares = found(split, tracks)
    assert shares["shadow"] > 0.95
    assert shares["object"] < 0.1
    assert shares["bright"] == 0


def test_an_object_and_a_light_differ_from_the_background_but_not_a_shadow():
    split, tracks = seen()
    differs = likeness_to_background(tracks.frames, tracks.pixels, split, backdrop(split), tracks).differs
    shares = dict(zip(ROWS, differs.reshape(len(ROWS), -1).mean(1).tolist(), strict=True))
    assert shares["shadow"] == 0
    assert min(shares["object"], shares["bright"]) > 0.9


def test_nothing_differs_from_what_is_never_seen_elsewhere(monkeypatch):
    monkeypatch.setattr(background, "REACH", 2 * SIDE)
    split, tracks = seen()
    assert not likeness_to_background(tracks.frames, tracks.pixels, split, backdrop(split), tracks).differs.any()


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
    looks = likeness_to_background(np.zeros(2, int), pixels, split, backdrop(split), tracks).alike
    assert looks.tolist() == [False, True]


def test_of_pixels_that_are_not_valid_nothing_is_said():
    split, tracks = seen()
    split = dataclasses.replace(split, valid=np.ones(split.images.shape[:3], bool))
    split.valid[3] = False
    here = tracks.frames == 3
    asked = tracks.frames[here], tracks.pixels[here], split, backdrop(split), tracks
    assert not np.any(likeness_to_background(*asked))


def test_pixels_that_are_not_valid_do_not_tell():
    split, tracks = seen()
    valid = np.ones(split.images.shape[:3], bool)
    valid[:-2] = False
    shares = found(dataclasses.replace(split, valid=valid), tracks)
    assert shares["shadow"] == 0


def test_black_is_like_black():
    split, tracks = seen()
    black = dataclasses.replace(split, images=np.zeros_like(split.images))
    looks = likeness_to_background(tracks.frames, tracks.pixels, black, backdrop(split), tracks)
    assert looks.alike.all()
    assert not looks.differs.any()


@pytest.mark.parametrize("frames", [5, 1000])
def test_a_few_frames_tell_what_the_background_looks_like(frames, monkeypatch):
    monkeypatch.setattr(background, "MAX_FRAMES", frames)
    split, tracks = seen()
    assert found(split, tracks)["shadow"] > 0.95


def test_a_long_clip_is_compared_part_by_part(monkeypatch):
    monkeypatch.setattr(background, "CLIP_PART", 6)
    split, tracks = seen()
    assert found(split, tracks)["shadow"] > 0.95
    images = np.array(split.images)
    images[6:] = np.roll(images[6:], 16, axis=2)  # the camera has gone elsewhere
    moved = dataclasses.replace(split, images=images)
    places = np.where((tracks.frames >= 6)[:, None], (tracks.pixels + np.array([16, 0])) % SIDE, tracks.pixels)
    assert found(moved, tracks._replace(pixels=places))["shadow"] > 0.95
    monkeypatch.setattr(background, "CLIP_PART", 100)
    assert found(moved, tracks._replace(pixels=places))["shadow"] < 0.9


def test_frames_of_several_cameras_count_as_one_instant(monkeypatch):
    monkeypatch.setattr(background, "CLIP_PART", 3)
    split, tracks = seen()
    once = np.repeat(np.arange(6), 2) / 6
    rig = dataclasses.replace(split, cameras=split.cameras._replace(time=once.astype(np.float32)))
    expected = likeness_to_background(tracks.frames, tracks.pixels, split, backdrop(split), tracks)
    monkeypatch.setattr(background, "CLIP_PART", 12)
    whole = likeness_to_background(tracks.frames, tracks.pixels, split, backdrop(split), tracks)
    monkeypatch.setattr(background, "CLIP_PART", 3)
    found = likeness_to_background(tracks.frames, tracks.pixels, rig, backdrop(rig), tracks)
    np.testing.assert_array_equal(found, whole)
    assert np.any(np.not_equal(expected, whole))


def test_many_pixels_are_compared_in_turn(monkeypatch):
    split, tracks = seen()
    expected = likeness_to_background(tracks.frames, tracks.pixels, split, backdrop(split), tracks)
    monkeypatch.setattr(background, "MAX_PIXELS", 7)
    in_turn = likeness_to_background(tracks.frames, tracks.pixels, split, backdrop(split), tracks)
    np.testing.assert_array_equal(in_turn, expected)
