"""Masks of what moves in front of a moving camera, in videos with known masks."""

import functools

import numpy as np
import pytest
from planar_video import HEIGHT, WIDTH, video

from l2dgs_jax.cameras.flow import LOST, match
from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.motion_masks.detection import moving_masks, partners, segmented
from l2dgs_jax.types import Camera

ACROSS, ALONG = (0.0, 0.09), (0.09, 0.0)  # to the camera's path; the board moves 3 pixels from frame to frame


def masks(film):
    found = dict(moving_masks(film.cameras, film.images, film.points))
    return np.stack([found[frame] for frame in range(len(film.images))])


@functools.cache
def masks_of(**settings):
    return masks(video(**settings))


def iou(first, second):
    return (first & second).sum() / (first | second).sum()


def test_masks_of_a_static_scene_are_empty_though_the_camera_moves():
    assert masks_of().mean() < 0.01


@pytest.mark.parametrize("direction", [ACROSS, ALONG])
def test_a_moving_board_is_found(direction):
    film = video(motion=direction)
    found = masks_of(motion=direction)
    assert iou(found, film.truth) > 0.7
    assert min(iou(*pair) for pair in zip(found, film.truth, strict=True)) > 0.5


def test_motion_in_front_of_a_static_camera_is_found():
    settings = {"motion": ALONG, "shift": 0.0}
    assert iou(masks_of(**settings), video(**settings).truth) > 0.7


def test_masks_do_not_depend_on_units_of_the_world_or_exposure():
    film, expected = video(motion=ACROSS), masks_of(motion=ACROSS)
    viewmat = film.cameras.viewmat.copy()
    viewmat[:, :3, 3] *= 1000
    larger = film._replace(cameras=film.cameras._replace(viewmat=viewmat), points=1000 * film.points)
    assert iou(masks(larger), expected) > 0.999
    darker = film._replace(images=(film.images / 4).astype(np.float16))
    assert iou(masks(darker), expected) > 0.95


def test_masks_do_not_depend_on_the_order_of_frames():
    film, expected = video(motion=ACROSS), masks_of(motion=ACROSS)
    order = np.random.default_rng(0).permutation(len(film.images))
    shuffled = film._replace(cameras=Camera(*(x[order] for x in film.cameras)), images=film.images[order])
    assert np.array_equal(masks(shuffled), expected[order])


def test_frames_of_a_single_instant_are_refused():
    film = video(frames=2)
    with pytest.raises(UserError, match="one instant; expected frames of at least two"):
        masks(film._replace(cameras=film.cameras._replace(time=np.zeros(2))))


def test_a_frame_that_sees_no_points_has_an_empty_mask():
    film = video(motion=ACROSS, frames=3)
    assert not masks(film._replace(points=film.points - [0, 0, 100])).any()


def test_partners_are_near_views_on_both_sides_and_one_of_the_same_instant():
    rng = np.random.default_rng(0)
    times = np.repeat(np.arange(20) / 19, 2)  # two cameras, one of them far to the side
    viewmat = np.tile(np.eye(4), (40, 1, 1))
    viewmat[1::2, 0, 3] = -2
    cameras = Camera(viewmat, np.tile(video(frames=2).cameras.K[:1], (40, 1, 1)), times)
    points = rng.uniform((-1, -1, 4), (1, 1, 6), (50, 3))
    chosen = partners(cameras, points, (WIDTH, HEIGHT), 20)
    assert chosen[0] == 21
    offsets = np.array(chosen[1:]) - 20
    assert (offsets % 2 == 0).all()
    assert sorted(abs(offsets) // 2) == sorted([1, 1, 2, 2, 4, 4, 7, 7])
    assert all(other % 2 for other in partners(cameras, points, (WIDTH, HEIGHT), 21)[1:])


def test_flow_that_leaves_the_picture_or_does_not_return_is_no_match():
    forward, backward = np.zeros((6, 8, 2), np.float32), np.zeros((6, 8, 2), np.float32)
    forward[..., 0], backward[..., 0] = 2, -2
    backward[3, 5] = (0, 0)
    matches = match(forward, backward)
    np.testing.assert_allclose(matches.positions[2, 1], [3.5, 2.5])
    assert matches.errors[3, 3] == 2
    assert (matches.errors[:, 6:] > LOST).all()
    assert matches.errors[:, :6].sum() == 2


def test_specks_are_removed_and_pinholes_closed():
    score = np.zeros((60, 80), np.float32)
    score[20:40, 20:50] = 1
    score[30, 30] = 0
    score[5, 5] = 1
    mask = segmented(score, np.where(score > 0, 255, 0).astype(np.uint8))
    assert mask[30, 30]
    assert not mask[5, 5]
    assert iou(mask, (score > 0) & (np.arange(60) > 10)[:, None]) > 0.9
