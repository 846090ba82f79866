"""Depths of tracks, estimated from what they hide and shared by neighbours that move alike."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from l2dgs_jax.cameras.geometry import pixel_rays
from l2dgs_jax.training.backdrop import DEPTH_CELL, depths_at
from l2dgs_jax.training.depths import Sights, shared_depths
from l2dgs_jax.training.feet import find_feet, just_below
from l2dgs_jax.training.tracks import Tracks, by_track

HEIGHT, WIDTH, FRAMES = 24, 32, 8
K = np.array([[30.0, 0, WIDTH / 2], [0, 30.0, HEIGHT / 2], [0, 0, 1]])


def track(number, start, velocity):
    """A track through all frames, at constant velocity."""
    frames = np.arange(FRAMES)
    return Tracks(np.full(FRAMES, number), frames, start + frames[:, None] * velocity, np.ones(FRAMES, bool))


def cells(value=2.0):
    return np.full((FRAMES, HEIGHT // DEPTH_CELL, WIDTH // DEPTH_CELL), value, np.float32)


def solved(tracks, hidden, factors=1.0, given=np.nan, focal_length=200.0, height=1000, background=None, reach=0.0):
    """Depths of tracks seen by a resting camera; feet end `reach` pixels below their tracks.

    Depths and factors are the same for all, or have a row for each track or a column for each frame.
    """
    merged = Tracks(*(np.concatenate(parts) for parts in zip(*tracks, strict=True)))
    factors, given = (np.broadcast_to(x, (len(tracks), FRAMES)).ravel() for x in (factors, given))
    count = len(merged.frames)
    rays = pixel_rays(merged.pixels, np.broadcast_to(np.eye(4), (count, 4, 4)), np.broadcast_to(K, (count, 3, 3)))
    times, centres = merged.frames / FRAMES, np.zeros((count, 3))
    at = lambda pixels: depths_at(hidden, merged.frames, pixels).astype(float)
    foreground = np.ones(count, bool) if background is None else ~background.ravel()
    below = just_below(merged, foreground)
    feet = find_feet(merged, foreground, below, height)
    foot = np.where(feet, at(merged.pixels + np.array([0, reach])), np.nan)
    sights = Sights(times, centres, rays, factors, at(merged.pixels), foot, given)
    return by_track(merged, shared_depths(merged, sights, below, focal_length))


def test_a_depth_on_which_all_agree_is_kept():
    tracks = [track(0, (4.5, 4.5), (1, 0.5)), track(1, (8.5, 6.5), (1, 0.5))]
    for depth in solved(tracks, cells()):
        assert_allclose(depth, 2, rtol=1e-3)


def test_neighbours_share_a_distance_if_they_move_alike():
    first = track(0, (4.5, 4.5), (1, 0))
    factors = np.array([[1.0], [2.0]])
    difference = {}
    for velocity in (1.0, -1.0):
        near, far = factors * solved([first, track(1, (10.5, 4.5), (velocity, 0))], cells(), factors)
        difference[velocity] = np.mean(far - near)
    assert difference[1.0] < 0.1
    assert difference[-1.0] > 1.5


def test_an_object_is_as_near_as_the_nearest_surface_that_it_hides():
    depths = cells(4.0)
    depths[:, 3:] = 2.0  # the ground that the lowest part stands on
    alike = [track(i, (4.5, 1.5 + 4 * i), (1, 0)) for i in range(5)]
    assert_allclose(solved(alike, depths), 2, rtol=1e-3)
    apart = [track(0, (15.5, 9.5), (-2, 0)), track(1, (20.5, 13.5), (0, 0))]
    assert solved(apart, depths)[0].min() > 3.5


@pytest.mark.parametrize("scale", [1, 2, 4])
@pytest.mark.parametrize(("difference", "together"), [(0.6, True), (1.6, False)])
def test_what_belongs_together_does_not_depend_on_the_size_of_the_picture(scale, difference, together):
    side, middle = 160 * scale, 80 * scale
    depths = np.full((FRAMES, side // DEPTH_CELL, side // DEPTH_CELL), 4.0, np.float32)
    depths[:, :, middle // DEPTH_CELL :] = 2.0  # what the right half hides
    columns = np.arange(middle - 20 * scale, middle + 20 * scale, 5) + 0.5
    faster = np.where(columns < middle, difference * scale, 0)
    tracks = [
        track(i, (x, middle - faster[i] * (FRAMES - 1) / 2), (0, faster[i] + scale)) for i, x in enumerate(columns)
    ]
    beside = (columns > middle - 5 * scale - 0.1) & (columns < middle)
    found = np.stack(solved(tracks, depths, focal_length=200.0 * scale))[beside]
    passing = found[:, FRAMES // 2 - 1 : FRAMES // 2 + 1]
    assert passing.max() < 3 if together else passing.min() > 3.5


def test_an_upright_object_has_one_horizontal_distance():
    alike = [track(i, (4.5, 4.5 + 4 * i), (1, 0)) for i in range(3)]
    factors = np.array([[1.0], [0.9], [0.8]])
    found = solved(alike, cells(), factors)
    assert_allclose(found * factors, 1.6, rtol=1e-3)  # that of the lowest part, at depth 2


def test_what_an_object_hides_in_distant_columns_does_not_count():
    depths = cells(4.0)
    depths[:, :, 6:] = 2.0
    row = [track(i, (2.5 + 5 * i, 12.5), (0, 0.5)) for i in range(6)]
    found = solved(row, depths)
    assert found[-1].max() < 3 < found[0].min()


def test_what_an_object_hides_above_its_foot_does_not_count():
    depths = cells(2.0)
    depths[:, 2] = 1.5  # a few points of something else
    body = [track(i, (4.5, 1.5 + 4 * i), (1, 0)) for i in range(5)]
    assert_allclose(solved(body, depths), 2, rtol=1e-3)
    assert np.max(solved(body[:3], depths)) < 1.6


def test_an_object_above_another_that_moves_otherwise_rests_on_it():
    depths = cells(4.0)
    depths[:, 4:] = 2.0
    upper, lower = (
        [track(i, (8.5, 1.5 + 4 * i), (v, 0)) for i in rows] for rows, v in ((range(4), 1), (range(4, 6), 0.2))
    )
    assert_allclose(solved(upper, depths), 4, rtol=1e-3)  # all of the ground below it is in view
    assert_allclose(solved([*upper, *lower], depths), 2, rtol=0.1)


def test_an_object_above_several_rests_on_the_farthest():
    depths = cells(4.0)
    depths[:, 3:] = 3.0
    depths[:, 4:] = 2.0
    upper = [track(i, (8.5 + 3 * i, 8.5), (0, 0.02)) for i in range(2)]
    legs = [track(2, (6.5, 14.5), (-0.8, 0)), track(3, (13.5, 17.5), (0.8, 0))]
    assert_allclose(np.array(solved([*upper, *legs], depths))[:2, 0], 3, rtol=0.1)


def test_a_shadow_below_an_object_is_not_its_foot():
    depths = cells(4.0)
    depths[:, 3:] = 3.0
    depths[:, 4:] = 2.0
    rows = [track(i, (8.5, 1.5 + 4 * i), (1, 0)) for i in range(5)]
    shadow = np.repeat(np.arange(5) == 4, FRAMES)
    assert_allclose(solved(rows, depths), 2, rtol=1e-3)
    assert_allclose(solved(rows, depths, background=shadow), 3, rtol=1e-3)


def test_the_end_of_a_foot_tells_where_it_stands():
    depths = cells(4.0)
    depths[:, 4:] = 2.0
    body = [track(i, (8.5, 1.5 + 4 * i), (1, 0)) for i in range(3)]
    assert_allclose(solved(body, depths), 4, rtol=1e-3)
    assert_allclose(solved(body, depths, reach=7.0), 2, rtol=1e-3)


def test_an_object_at_the_lower_border_may_be_nearer_than_what_it_hides():
    near = cells()
    near[FRAMES // 2 :] = 4.0
    leaving = [track(0, (4.5, 4.5), (1, 2))]
    last = {height: solved(leaving, near, height=height)[0][-1] for height in (22, 1000)}
    assert last[22] < last[1000] - 0.3


def test_things_that_move_alike_for_a_while_are_not_one_object():
    depths = cells(4.0)
    depths[:, 4:] = 2.0
    upper = [track(i, (4.5, 1.5 + 4 * i), (1, 0)) for i in range(4)]
    lower = [track(i, (10.5, 1.5 + 4 * i), (1, 0)) for i in range(4, 6)]
    assert_allclose(solved([*upper, *lower], depths), 2, rtol=1e-3)
    turning = np.where(np.arange(FRAMES) < FRAMES // 2, 0, 3 * (np.arange(FRAMES) - FRAMES // 2))[:, None] * (1, 0)
    parting = [part._replace(pixels=part.pixels + turning) for part in lower]
    assert solved([*upper, *parting], depths)[0][0] > 3


def test_a_few_wrong_depths_do_not_move_a_track():
    depths = cells(4.0)
    depths[3] = 1.0
    (depth,) = solved([track(0, (4.5, 4.5), (1, 0.5))], depths)
    assert_allclose(depth, 4, rtol=0.1)


def test_depth_changes_gradually_along_a_track():
    depths = cells()
    depths[4:] = 3.0
    (depth,) = solved([track(0, (4.5, 4.5), (1, 0.5))], depths)
    assert (np.diff(depth) > 0).all()
    assert np.diff(depth).max() < 0.3


def test_where_no_point_is_in_view_depth_comes_from_the_rest_of_the_track():
    depths = cells()
    depths[3:5] = np.nan
    (depth,) = solved([track(0, (4.5, 4.5), (1, 0.5))], depths)
    assert_allclose(depth, 2, rtol=1e-3)


def test_depth_that_is_given_outweighs_the_guess():
    (depth,) = solved([track(0, (4.5, 4.5), (1, 0.5))], cells(), given=np.where(np.arange(FRAMES) == 3, 1.5, np.nan))
    assert_allclose(depth[3], 1.5, rtol=0.05)
    assert depth[-1] > depth[3]


@pytest.mark.parametrize("factor", [1.0, 0.7])
def test_given_depth_is_no_horizontal_distance(factor):
    (depth,) = solved([track(0, (4.5, 4.5), (1, 0.5))], cells(), factor, given=1.5)
    assert_allclose(depth, 1.5, rtol=1e-3)


def shaken(amount, guess, factor=1.0, unit=1.0):
    """Found over true depths of a track at depth 2, seen by a shaking camera."""
    frames = 24
    centres = np.random.default_rng(0).normal(size=(frames, 3)) * (amount, amount, 0)
    path = np.array([0.0, 0.0, 2.0]) + np.linspace(-0.3, 0.3, frames)[:, None] * (1.0, 0.5, 0)
    rays = (path - centres) / 2
    track = Tracks(np.zeros(frames, int), np.arange(frames), 30.0 * rays[:, :2] + 50, np.ones(frames, bool))
    unknown, hidden = np.full(frames, np.nan), np.full(frames, guess * unit)
    sights = Sights(track.frames / frames, centres * unit, rays, np.full(frames, factor), hidden, hidden, unknown)
    return shared_depths(track, sights, np.empty((2, 0), int), 200.0) / (2.0 * unit)


@pytest.mark.parametrize("guess", [1.0, 4.0])
@pytest.mark.parametrize("factor", [1.0, 0.7])
@pytest.mark.parametrize("amount", [0.02, 0.1, 0.4])
def test_what_moves_smoothly_is_where_the_shaking_of_the_camera_tells(amount, factor, guess):
    assert_allclose(shaken(amount, guess, factor), 1, rtol=0.05)
    assert_allclose(shaken(0.0, guess, factor), guess / 2, rtol=0.05)  # a camera at rest tells nothing


@pytest.mark.parametrize("unit", [0.01, 1000.0])
def test_depths_do_not_depend_on_the_unit_of_length(unit):
    assert_allclose(shaken(0.01, 3.0, unit=unit), shaken(0.01, 3.0), rtol=1e-3)


@pytest.mark.parametrize("length", [FRAMES, 2])
def test_what_nothing_is_known_about_is_as_far_away_as_the_rest(length):
    depths = cells()
    depths[:, :, WIDTH // DEPTH_CELL // 2 :] = np.nan
    unknown = Tracks(*(x[:length] for x in track(1, (28.5, 4.5), (0, 0.5))))
    merged = Tracks(*(np.concatenate(parts) for parts in zip(track(0, (4.5, 4.5), (0, 0.5)), unknown, strict=True)))
    count = len(merged.frames)
    rays = pixel_rays(merged.pixels, np.broadcast_to(np.eye(4), (count, 4, 4)), np.broadcast_to(K, (count, 3, 3)))
    hidden, nothing = depths_at(depths, merged.frames, merged.pixels).astype(float), np.full(count, np.nan)
    sights = Sights(merged.frames / FRAMES, np.zeros((count, 3)), rays, np.ones(count), hidden, nothing, nothing)
    assert_allclose(shared_depths(merged, sights, np.zeros((2, 0), int), 200.0), 2, rtol=0.02)
