"""Views interpolated between frames, compared with how a moving texture really looks at that time."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_training import assert_equal_states, finish, make_dataset, state_of, tiny

from l2dgs_jax.cameras.geometry import between, camera_centres
from l2dgs_jax.data import Split, load_dataset
from l2dgs_jax.training import engine, initial_state
from l2dgs_jax.training.batching import load_batch, next_batch, view_indices
from l2dgs_jax.training.flows import Flows, neighbour_flows
from l2dgs_jax.training.inbetweens import draw
from l2dgs_jax.types import Camera

WIDTH, HEIGHT, FRAMES, SPEED = 96, 64, 5, 5.0  # pixels a frame
PATCH = slice(20, 44), slice(30, 60)


def texture(columns, rows):
    """Smooth, with detail in every direction, dark, sRGB."""
    waves = [(0.31, 0.13), (-0.17, 0.29), (0.43, -0.37), (0.11, 0.07), (-0.53, 0.41)]
    value = sum(np.sin(a * columns + b * rows + i) for i, (a, b) in enumerate(waves))
    return (0.1 + 0.015 * value)[..., None] * [1.0, 0.9, 0.8]


def picture(time):
    """The image `time` frames after the first: everything moves to the right."""
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return texture(columns - SPEED * time, rows)


@pytest.fixture(scope="module")
def split():
    viewmat = np.tile(np.eye(4, dtype=np.float32), (FRAMES, 1, 1))
    viewmat[:, 0, 3] = -0.1 * np.arange(FRAMES)
    intrinsics = np.tile(np.array([[80, 0, 48], [0, 80, 32], [0, 0, 1]], np.float32), (FRAMES, 1, 1))
    order = np.array([2, 0, 4, 1, 3])  # frames need not come in the order of time
    cameras = Camera(viewmat[order], intrinsics, (order / (FRAMES - 1)).astype(np.float32))
    images = np.stack([picture(time) for time in order]).astype(np.float16)
    return Split(tuple(map(str, order)), cameras, images)


@pytest.fixture(scope="module")
def flows(split):
    return neighbour_flows(split, filled=True)


def test_following_frames_are_in_order_of_time(flows):
    np.testing.assert_array_equal(flows.following, [4, 3, 2, 0, 2])  # frame 2 is the last in time


@pytest.mark.parametrize("part", [0.25, 0.5, 0.8])
def test_a_view_between_two_frames_shows_the_true_image(split, flows, part):
    view = draw(split, flows, frame=3, part=part)  # the second in time
    truth = picture(1 + part)
    inner = np.zeros((HEIGHT, WIDTH), bool)
    inner[8:-8, 16:-16] = True
    assert view.valid[inner].mean() > 0.9
    counted = view.valid & inner
    error = np.abs(view.image.astype(float) - truth)[counted].mean()
    faded = (1 - part) * picture(1) + part * picture(2)
    assert error < 0.2 * np.abs(faded - truth)[counted].mean()
    np.testing.assert_allclose(view.camera.time, (1 + part) / (FRAMES - 1), rtol=1e-6)
    np.testing.assert_allclose(view.camera.viewmat[0, 3], -0.1 * (1 + part), rtol=1e-5)


def test_frames_of_different_exposure_agree_and_views_between_them_have_that_of_the_nearer(split, flows):
    gains = np.where(split.cameras.time * (FRAMES - 1) % 2, 0.7, 1).astype(np.float16)
    flickering = dataclasses.replace(split, images=split.images * gains[:, None, None, None])
    found = neighbour_flows(flickering, filled=True)
    for frame in np.flatnonzero(flows.following != np.arange(FRAMES)).tolist():
        steady, view = draw(split, flows, frame, 0.3), draw(flickering, found, frame, 0.3)
        assert view.valid.mean() > steady.valid.mean() - 0.05
        both = view.valid & steady.valid
        np.testing.assert_allclose(view.image[both], gains[frame] * steady.image[both], rtol=0.1)


def test_depth_is_given_only_at_valid_pixels_of_real_frames(split, flows):
    depths = np.full(split.images.shape[:-1], 2.0, np.float32)
    valid = np.ones(depths.shape, bool)
    valid[:, :5] = False
    known = dataclasses.replace(split, depths=depths, valid=valid)
    config = tiny(inbetweens=0.5, batch_size=4)
    times, drawn = set(split.cameras.time.tolist()), 0
    for number in range(4):
        batch = next_batch(known, config, number, flows)
        for time, depth in zip(batch.cameras.time.tolist(), batch.depths, strict=True):
            drawn += time not in times
            np.testing.assert_array_equal(depth, np.where(valid[0], 2.0 * (time in times), 0))
    assert 0 < drawn < 16
    assert (depths == 2).all()


def test_content_of_only_one_frame_is_invalid_between_frames(split):
    images = split.images.copy()
    images[3][PATCH] = 0.4
    view = draw(dataclasses.replace(split, images=images), neighbour_flows(split), frame=3, part=0.5)
    moved = slice(20, 44), slice(34, 60)  # where both the patch and the texture it replaces move to
    assert view.valid[moved].mean() < 0.1
    assert view.valid[:16].mean() > 0.7
    assert not view.image[~view.valid].any()


def test_edges_may_differ_by_a_pixel_but_not_by_five(split):
    rng = np.random.default_rng(0)
    stripes = np.where(np.arange(WIDTH) // 16 % 2, 0.3, 0.1)[None, :, None] * np.ones((HEIGHT, 1, 3))
    images = np.tile(stripes, (FRAMES, 1, 1, 1)) + rng.normal(0, 0.002, (FRAMES, HEIGHT, WIDTH, 3))
    no_motion = Flows(np.array([4, 3, 2, 0, 2]), np.zeros((FRAMES, 2, HEIGHT, WIDTH, 2), np.float16))
    shares = []
    for shift in (1, 5):
        images[0] = np.roll(images[3], shift, axis=1)
        view = draw(dataclasses.replace(split, images=images.astype(np.float16)), no_motion, frame=3, part=0.5)
        shares.append(view.valid[:, 8:-8].mean())
    assert shares[0] > 0.95
    assert shares[1] < 0.8


def test_invalid_pixels_stay_invalid_between_frames(split, flows):
    valid = np.ones(split.images.shape[:3], bool)
    valid[3, :, 40:50] = False
    view = draw(dataclasses.replace(split, valid=valid), flows, frame=3, part=0.5)
    assert not view.valid[:, 43:52].any()  # where their content has moved to
    assert view.valid[:, 20:40].mean() > 0.7


def test_with_several_cameras_a_frame_of_the_nearest_one_follows():
    cameras = make_dataset().train.cameras
    rig = Camera(*(np.concatenate([x, x]) for x in cameras))
    rig.viewmat[6:, 1, 3] += 5
    images = np.zeros((12, 24, 32, 3), np.float16)
    following = neighbour_flows(Split(tuple("abcdefghijkl"), rig, images)).following
    np.testing.assert_array_equal(following, [1, 2, 3, 4, 5, 5, 7, 8, 9, 10, 11, 11])


def test_frames_that_do_not_match_are_not_interpolated():
    noise = np.random.default_rng(0).uniform(0, 0.3, (FRAMES, HEIGHT, WIDTH, 3)).astype(np.float16)
    cameras = Camera(*(x[:FRAMES] for x in make_dataset().train.cameras))
    np.testing.assert_array_equal(
        neighbour_flows(Split(tuple("abcde"), cameras, noise), filled=True).following, range(FRAMES)
    )


def test_frames_across_a_cut_are_not_interpolated(split):
    images = split.images.copy()
    images[2] = images[2, ::-1, ::-1] ** 2  # the last in time
    following = neighbour_flows(dataclasses.replace(split, images=images), filled=True).following
    np.testing.assert_array_equal(following, [4, 3, 2, 0, 4])


def test_filled_flow_gives_more_correct_pixels():
    """Given every fourth frame of a real clip, the frames half-way between are interpolated."""
    whole = load_dataset("demo").train
    order = np.argsort(whole.cameras.time)[:17]
    kept = order[::4]
    few = Split(tuple(map(str, kept)), Camera(*(x[kept] for x in whole.cameras)), whole.images[kept])

    def correct_share(filled):
        flows, shares = neighbour_flows(few, filled=filled), []
        for frame, middle in enumerate(order[2::4]):
            view = draw(few, flows, frame, part=0.5)
            error = np.abs(view.image.astype(float) - whole.images[middle]).mean(-1)
            shares.append(np.mean(view.valid & (error < 0.02)))
        return np.mean(shares)

    assert correct_share(filled=True) > 1.2 * correct_share(filled=False)


def test_between_interpolates_centres_rotations_intrinsics_and_time():
    rotations = Rotation.from_euler("y", [[0], [40]], degrees=True).as_matrix()
    viewmat = np.tile(np.eye(4), (2, 1, 1))
    viewmat[:, :3, :3] = rotations
    viewmat[:, :3, 3] = -np.einsum("fij,fj->fi", rotations, [[0, 0, 0], [1, 2, 3]])
    cameras = Camera(viewmat, np.stack([np.diag([10.0, 10, 1]), np.diag([20.0, 20, 1])]), np.array([0.2, 0.6]))
    middle = between(cameras, 0, 1, 0.25)
    np.testing.assert_allclose(camera_centres(middle.viewmat), [0.25, 0.5, 0.75], atol=1e-12)
    np.testing.assert_allclose(
        Rotation.from_matrix(middle.viewmat[:3, :3]).as_euler("yxz", True), [10, 0, 0], atol=1e-9
    )
    np.testing.assert_allclose(middle.K[0, 0], 12.5)
    np.testing.assert_allclose(middle.time, 0.3)
    for end in (0, 1):
        for x, y in zip(between(cameras, 0, 1, float(end)), (x[end] for x in cameras), strict=True):
            np.testing.assert_allclose(x, y, atol=1e-12)


def test_batches_mix_frames_and_views_between_them(split, flows):
    config = tiny(inbetweens=0.5, batch_size=2)
    kinds = []
    for step in range(40):
        batch = next_batch(split, config, step, flows)
        again = next_batch(split, config, step, flows)
        jax.tree.map(np.testing.assert_array_equal, batch, again)
        for row, frame in enumerate(view_indices(config.seed, step, 2, FRAMES)):
            plain = load_batch(split, np.array([frame]))
            is_frame = bool(batch.cameras.time[row] == plain.cameras.time[0])
            kinds.append(is_frame)
            assert batch.frames[row] == np.abs(split.cameras.time - batch.cameras.time[row]).argmin()
            if is_frame:
                np.testing.assert_array_equal(batch.images[row], plain.images[0])
                assert batch.valid[row].all()
            else:
                assert 0 <= batch.cameras.time[row] - plain.cameras.time[0] <= 1 / (FRAMES - 1) + 1e-6
                assert not batch.valid[row].all()
    # No view is drawn after the last of the five frames.
    assert 0.4 < np.mean(kinds) < 0.8


def test_longer_gaps_between_frames_are_interpolated_more_often(split, flows):
    times = np.array([0.0, 0.1, 0.2, 0.4, 1.0], np.float32)  # in order of time; these are the frames 1, 3, 0, 4, 2
    cameras = split.cameras._replace(time=times[[2, 0, 4, 1, 3]])
    uneven = dataclasses.replace(split, cameras=cameras)
    counts = np.zeros((2, FRAMES))
    for step in range(400):
        config = tiny(inbetweens=0.4, batch_size=2)
        frames = view_indices(config.seed, step, 2, FRAMES)
        between_frames = next_batch(uneven, config, step, flows).cameras.time != cameras.time[frames]
        np.add.at(counts, (between_frames.astype(int), frames), 1)
    share = counts[1] / counts.sum(0)
    assert share[2] == 0  # the last in time
    gaps = np.array([0.2, 0.1, 0, 0.1, 0.6])  # by frame, 0.25 on average
    np.testing.assert_allclose(share, 0.4 * gaps / (0.6 * 0.25 + 0.4 * gaps), atol=0.1)


def test_without_inbetweens_batches_consist_of_frames(split):
    batch = next_batch(split, tiny(), 3, None)
    np.testing.assert_array_equal(batch.images, split.images[batch.frames])
    assert batch.valid is None


@pytest.mark.slow
def test_a_training_with_inbetweens_resumes_exactly():
    dataset, config = make_dataset(), tiny(inbetweens=0.9, coarse_steps=0, fine_steps=4)
    steps = engine.run([engine.Member(dataset.train, config, initial_state(dataset, config))])
    states = [jax.device_get(state_of(progress)) for progress in steps]
    resumed = state_of(finish(dataset, config, jax.tree.map(jnp.asarray, states[1])))
    assert_equal_states(resumed, states[-1])


def test_pixels_that_are_not_valid_do_not_make_a_cut(split):
    noise = np.random.default_rng(0).normal(0, 0.01, split.images.shape)
    valid = np.ones(split.images.shape[:3], bool)
    valid[:, :, :8] = valid[:, :, -8:] = False
    images = np.where(valid[..., None], split.images + noise, 0).astype(np.float16)
    flows = neighbour_flows(dataclasses.replace(split, images=images, valid=valid))
    np.testing.assert_array_equal(flows.following, [4, 3, 2, 0, 2])
    assert np.isnan(flows.displacements[:, :, :, :8]).all()


def test_a_cut_is_found_inside_a_border_that_is_not_valid():
    """A border is the same in all frames, so that flow seems to explain much of them."""
    noise = np.random.default_rng(0).uniform(0, 0.3, (FRAMES, HEIGHT, WIDTH, 3))
    valid = np.ones(noise.shape[:3], bool)
    valid[:, :6] = valid[:, -6:] = valid[:, :, :6] = valid[:, :, -6:] = False
    cameras = Camera(*(x[:FRAMES] for x in make_dataset().train.cameras))
    images = np.where(valid[..., None], noise, 0).astype(np.float16)
    flows = neighbour_flows(Split(tuple("abcde"), cameras, images, valid=valid), filled=True)
    np.testing.assert_array_equal(flows.following, range(FRAMES))
