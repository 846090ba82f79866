"""Seeds (new Gaussians with paths) found on the moving square of a clip, and their training."""

import dataclasses
import functools
import json
import sys

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from clips import FOCAL, HEIGHT, WIDTH, camera, clip, render
from tiny_training import FRAMES, assert_equal_states, finish, make_dataset, state_of, tiny

from l2dgs_jax.cameras.geometry import camera_centres, pixel_rays, points_inside
from l2dgs_jax.config import ModelConfig, overrides
from l2dgs_jax.data import Split
from l2dgs_jax.model.deformation import path_weights
from l2dgs_jax.model.initialisation import Seeds, path_knots
from l2dgs_jax.runs import checkpoints
from l2dgs_jax.runs.checkpoints import Checkpoint
from l2dgs_jax.training import initial_state
from l2dgs_jax.training.backdrop import find_backdrop
from l2dgs_jax.training.moving_tracks import moving_tracks
from l2dgs_jax.training.seeds import find_seeds
from l2dgs_jax.training.state import with_capacity
from l2dgs_jax.training.step import densify
from l2dgs_jax.types import Camera

COUNT, KNOTS, MANY = 14, 7, 10_000
SQUARE = -0.5  # where on the z axis the moving square is
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float32)


def surfaces():
    """Points on the wall, the floor and the board of the clip; none on the moving square."""
    x, y = np.meshgrid(np.linspace(-4, 4, 40), np.linspace(-3, 0.9, 25))
    wall = np.stack([x, y, np.full_like(x, 2.0)], axis=-1)
    x, z = np.meshgrid(np.linspace(-4, 4, 40), np.linspace(-2, 2, 30))
    floor = np.stack([x, np.ones_like(x), z], axis=-1)
    x, y = np.meshgrid(np.linspace(0.1, 1.3, 12), np.linspace(-0.3, 0.9, 12))
    board = np.stack([x, y, np.full_like(x, 0.6)], axis=-1)
    return np.concatenate([part.reshape(-1, 3) for part in (wall, floor, board)]).astype(np.float32)


@functools.cache
def filmed(block):
    pictures, views, squares = clip(COUNT, reach=0.3, light=0.2, block=block)
    cameras = Camera(
        np.stack(views).astype(np.float32),
        np.tile(K, (COUNT, 1, 1)),
        np.linspace(0, 1, COUNT, dtype=np.float32),
    )
    return Split(tuple(map(str, range(COUNT))), cameras, np.stack(pictures).astype(np.float16)), squares


def filmed_at(heights, reach):
    """The moving square at these heights, one a frame, seen along a part of the camera's arc; and where it is."""
    count = len(heights)
    views = [camera(reach * (2 * i / (count - 1) - 1)) for i in range(count)]
    pictures, squares = zip(*(render(view, height) for view, height in zip(views, heights, strict=True)), strict=True)
    images = 0.2 * np.stack(pictures) + np.random.default_rng(0).normal(0, 0.004, (count, HEIGHT, WIDTH, 3))
    times = np.linspace(0, 1, count, dtype=np.float32)
    cameras = Camera(np.stack(views).astype(np.float32), np.tile(K, (count, 1, 1)), times)
    return Split(tuple(map(str, range(count))), cameras, np.clip(images, 0, 1).astype(np.float16)), squares


@functools.cache
def found():
    return find_seeds(surfaces(), filmed(block=True)[0], KNOTS, MANY)


def projected(seeds, split, frame):
    """Pixels to which the seeds alive in a frame project, displaced by their paths."""
    time, viewmat = float(split.cameras.time[frame]), split.cameras.viewmat[frame]
    live = (seeds.lifetimes[:, 0] <= time) & (time <= seeds.lifetimes[:, 1])
    weights = np.asarray(path_weights(jnp.array([time]), seeds.paths.shape[1]))[0]
    local = (seeds.points[live] + weights @ seeds.paths[live]) @ viewmat[:3, :3].T + viewmat[:3, 3]
    return (local @ K.T)[:, :2] / local[:, 2:]


def places(seeds, split, frame):
    """Rows and columns of the pixels to which they project, those outside moved to the border."""
    columns, rows = np.clip(projected(seeds, split, frame).astype(int), 0, [WIDTH - 1, HEIGHT - 1]).T
    return rows, columns


def covered_share(square, places):
    """Share of the square's pixels that lie within four pixels of one of the places."""
    covered = np.zeros(square.shape, np.uint8)
    covered[places] = 1
    return cv2.dilate(covered, np.ones((9, 9), np.uint8))[square].mean()


@pytest.mark.parametrize("frame", [2, 6, 11])
def test_seeds_follow_and_cover_the_moving_square(frame):
    split, squares = filmed(block=True)
    at = places(found(), split, frame)
    assert cv2.dilate(squares[frame].astype(np.uint8), np.ones((9, 9), np.uint8))[at].mean() > 0.85
    assert covered_share(squares[frame], at) > 0.85


def test_seeds_are_found_however_the_exposure_flickers():
    split, squares = filmed(block=True)
    gains = np.where(np.arange(COUNT) % 2, 0.8, 1.0).astype(np.float16)
    flickering = dataclasses.replace(split, images=split.images * gains[:, None, None, None])
    seeds = find_seeds(surfaces(), flickering, KNOTS, MANY)
    for frame in (2, 6, 11):
        assert covered_share(squares[frame], places(seeds, split, frame)) > 0.8


@pytest.mark.parametrize("every", [3, 6])
def test_what_moves_by_half_its_size_or_more_from_frame_to_frame_is_covered(every):
    split, squares = filmed(block=True)
    few = Split(split.names[::every], Camera(*(x[::every] for x in split.cameras)), split.images[::every])
    seeds = find_seeds(surfaces(), few, KNOTS, MANY)
    for index, square in enumerate(squares[::every]):
        assert covered_share(square, places(seeds, few, index)) > 0.9


@pytest.mark.parametrize(("speed", "step"), [(0.7, 2), (2.5, 1)])
def test_slow_things_are_followed_between_instants_further_apart(speed, step):
    """Speeds in pixels a frame, of which flow does not tell the lower one from its errors."""
    count, unit = 60, 73  # frames; pixels that the square moves by if it moves by 1
    split, squares = filmed_at(0.8 - speed / unit * np.arange(count), reach=0.2)
    found, backdrop, tracks = moving_tracks(split, find_backdrop(surfaces(), split.cameras, HEIGHT, WIDTH), MANY)
    assert found.names == split.names[::step]
    np.testing.assert_array_equal(backdrop.cameras.viewmat, np.float64(found.cameras.viewmat))
    for frame in (10, 24):
        columns, rows = tracks.pixels[tracks.frames == frame // step].astype(int).T
        assert cv2.dilate(squares[frame].astype(np.uint8), np.ones((9, 9), np.uint8))[rows, columns].mean() > 0.85
        assert covered_share(squares[frame], (rows, columns)) > 0.85


def test_what_sets_off_slowly_is_followed_back_to_where_it_rested():
    rest, acceleration, fastest = 5, 0.015, 0.09  # frames at rest; then how much faster a frame, up to what speed
    heights = 0.5 - np.cumsum(np.clip(acceleration * (np.arange(COUNT) - rest + 1), 0, fastest))
    split, squares = filmed_at(heights, reach=0.1)
    seeds = find_seeds(surfaces(), split, KNOTS, MANY)
    for frame in (0, rest - 2):
        at = places(seeds, split, frame)
        assert cv2.dilate(squares[frame].astype(np.uint8), np.ones((9, 9), np.uint8))[at].mean() > 0.85
        assert covered_share(squares[frame], at) > 0.4


def test_seeds_have_the_colours_of_the_moving_square():
    split, squares = filmed(block=True)
    shown = np.concatenate([image[square] for image, square in zip(split.images, squares, strict=True)])
    np.testing.assert_allclose(found().colors.mean(0), shown.mean(0), atol=0.01)
    assert np.corrcoef(found().colors.T).min() < 0.99


def test_where_nothing_moves_there_are_no_seeds():
    assert len(find_seeds(surfaces(), filmed(block=False)[0], KNOTS, MANY).points) < 0.03 * len(found().points)


def test_the_number_of_seeds_is_limited_and_the_longest_lived_are_kept():
    few = find_seeds(surfaces(), filmed(block=True)[0], KNOTS, 20)
    length = lambda seeds: seeds.lifetimes[:, 1] - seeds.lifetimes[:, 0]
    assert len(few.points) == 20
    assert length(few).min() >= np.sort(length(found()))[-60]


def test_seeds_of_the_first_and_of_the_last_frame_are_visible_before_and_after_these():
    split = filmed(block=True)[0]
    cameras = split.cameras._replace(time=np.linspace(0.1, 0.9, COUNT, dtype=np.float32))
    first, last = find_seeds(surfaces(), dataclasses.replace(split, cameras=cameras), KNOTS, MANY).lifetimes.T
    visible = lambda time: np.count_nonzero((first <= time) & (time <= last))
    assert visible(0.0) == visible(cameras.time[0]) > 0
    assert visible(1.0) == visible(cameras.time[-1]) > 0


def measured(split, squares):
    """Depth at the pixels of the points and of the square, in an unknown unit and with an unknown shift."""
    depths = np.zeros(split.images.shape[:3], np.float32)
    for depth, square, viewmat in zip(depths, squares, split.cameras.viewmat, strict=True):
        _, pixels, distances = points_inside(surfaces(), viewmat, K, (WIDTH, HEIGHT))
        order = np.argsort(-distances)  # the nearest point of a pixel is the one that remains
        columns, rows = pixels[order].astype(int).T
        depth[rows, columns] = distances[order]
        rows, columns = np.nonzero(square)
        rays = pixel_rays(np.stack([columns, rows], axis=-1) + 0.5, viewmat, K)
        depth[rows, columns] = (SQUARE - camera_centres(viewmat)[2]) / rays[:, 2]
        depth[depth > 0] = 1 / (3 / depth[depth > 0] + 0.5)
    return depths


def test_seeds_lie_where_measured_depth_puts_them():
    split, squares = filmed(block=True)
    seeds = find_seeds(surfaces(), dataclasses.replace(split, depths=measured(split, squares)), KNOTS, MANY)
    error = lambda seeds: np.abs(seeds.points[:, 2] - SQUARE)
    assert np.quantile(error(seeds), 0.8) < 0.05 < 0.5 * np.median(error(found()))


@pytest.mark.parametrize("why", ["noise", "no points in view", "not valid"])
def test_without_reliable_flow_or_depth_there_are_no_seeds(why):
    split, points = filmed(block=True)[0], surfaces()
    if why == "noise":
        images = np.random.default_rng(0).uniform(0, 0.3, split.images.shape).astype(np.float16)
        split = dataclasses.replace(split, images=images)
    elif why == "no points in view":
        points = points - np.float32([0, 0, 100])
    else:
        split = dataclasses.replace(split, valid=np.zeros(split.images.shape[:3], bool))
    seeds = find_seeds(points, split, KNOTS, MANY)
    assert [x.shape for x in seeds] == [(0, 3), (0, 3), (0,), (0, KNOTS, 3), (0, 2)]


TWO_SEEDS = Seeds(
    points=np.array([[0.1, 0.2, 2.5], [-0.3, 0.1, 2.2]], np.float32),
    colors=np.array([[0.1, 0.12, 0.11], [0.2, 0.1, 0.05]], np.float32),
    spacings=np.array([0.1, 0.2], np.float32),
    paths=np.random.default_rng(0).uniform(-0.2, 0.2, (2, path_knots(ModelConfig(), FRAMES), 3)).astype(np.float32),
    lifetimes=np.array([[0, 0.5], [0.3, 1]], np.float32),
)


@pytest.fixture
def tracked(monkeypatch):
    """Settings and an initial state with the two seeds."""
    module = sys.modules["l2dgs_jax.training.initial_state"]  # its function has the same name
    monkeypatch.setattr(module, "find_seeds", lambda *_: TWO_SEEDS)
    config = tiny(coarse_steps=3, fine_steps=0)
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, tracks=True))
    return config, initial_state(make_dataset(), config)


def test_a_training_starts_with_the_seeds_after_the_points(tracked):
    scene = tracked[1].scene
    points = len(make_dataset().points)
    gaussians = jax.tree.map(lambda rows: np.asarray(rows)[points : points + 2], scene.params.gaussians)
    assert int(scene.alive.sum()) == points + 2
    np.testing.assert_allclose(gaussians.means, TWO_SEEDS.points)
    np.testing.assert_allclose(scene.params.paths[scene.path_of[points : points + 2]], TWO_SEEDS.paths)
    np.testing.assert_allclose(gaussians.lifetimes, TWO_SEEDS.lifetimes)
    first, second = gaussians.reflectance
    assert first[0] < second[0]
    assert first[2] > second[2]
    assert np.isinf(scene.params.gaussians.lifetimes[:points]).all()


def test_the_largest_number_of_gaussians_limits_the_seeds(tracked, monkeypatch):
    asked = []
    module = sys.modules["l2dgs_jax.training.initial_state"]
    monkeypatch.setattr(module, "find_seeds", lambda *given: asked.append(given[3]) or TWO_SEEDS)
    for limit in (5, 10**6):
        initial_state(make_dataset(), overrides.replace(tracked[0], {"density.max_gaussians": limit}))
    assert asked[0] == 5 < asked[1] < 10**6  # the second by the number of pixels


@pytest.mark.slow
def test_only_paths_that_are_followed_are_learned(tracked):
    config, start = tracked
    followed = jnp.isfinite(start.scene.params.gaussians.lifetimes).all(-1)
    start = start._replace(scene=start.scene._replace(path_of=jnp.where(followed, start.scene.path_of, 2)))
    end = state_of(finish(make_dataset(), config, start)).scene
    before, after = (np.asarray(scene.params.paths) for scene in (start.scene, end))
    moved = np.abs(after - before).max((1, 2))
    assert (moved[:2] > 0).all()
    assert not moved[2:].any()


@pytest.mark.parametrize("method", ["mcmc", "adaptive"])
def test_paths_are_shared_at_births_and_saved_in_checkpoints(tracked, tmp_path, method):
    config, state = tracked
    rows = 2 * len(state.scene.alive)
    config = overrides.replace(config, {"density.method": method, "density.max_gaussians": rows})
    state = with_capacity(state, rows)
    ones = lambda tree: jax.tree.map(jnp.ones_like, tree)
    adam = state.adam._replace(mu=ones(state.adam.mu), nu=ones(state.adam.nu))
    state = state._replace(adam=adam, stats=ones(state.stats))
    grown, missing = densify(state, config, 1)
    assert missing == 0
    lifetimes, path_of = np.asarray(grown.scene.params.gaussians.lifetimes), np.asarray(grown.scene.path_of)
    followed = path_of[np.asarray(grown.scene.alive) & np.isfinite(lifetimes).all(-1)]
    assert len(followed) > 2
    for row, own in enumerate(path_of):
        if np.isfinite(lifetimes[row]).all() and grown.scene.alive[row]:
            np.testing.assert_array_equal(lifetimes[row], TWO_SEEDS.lifetimes[own])
    as_before = np.bincount(followed, minlength=len(grown.scene.params.paths)) < 2
    for moments in (grown.adam.mu, grown.adam.nu):
        np.testing.assert_array_equal(moments.paths.all((1, 2)), as_before)  # anew where there are more followers
    checkpoints.save(tmp_path / "checkpoint.npz", Checkpoint(grown, 64), config)
    assert_equal_states(checkpoints.load(tmp_path / "checkpoint.npz", config, FRAMES).state, grown)


def with_paths(state):
    """The parts of a state that have an array of paths."""
    return state.scene.params, state.adam.mu, state.adam.nu


def test_checkpoints_in_which_each_gaussian_has_a_path_of_its_own_are_read(tracked, tmp_path):
    """As versions before shared paths wrote them."""
    config, state = tracked
    ramp = np.linspace(1, 2, state.scene.params.paths.size).reshape(state.scene.params.paths.shape)
    mu, nu = state.adam.mu._replace(paths=jnp.asarray(ramp)), state.adam.nu._replace(paths=jnp.asarray(2 * ramp))
    state = state._replace(adam=state.adam._replace(mu=mu, nu=nu))
    path = tmp_path / "checkpoint.npz"
    checkpoints.save(path, Checkpoint(state, 64), config)
    with np.load(path) as file:
        arrays = dict(file)
    path_of = arrays.pop(".scene.path_of")
    for part in (".scene.params", ".adam.mu", ".adam.nu"):
        arrays[f"{part}.gaussians.paths"] = arrays.pop(f"{part}.paths")[path_of]
    arrays["header"] = np.array(json.dumps(json.loads(str(arrays["header"])) | {"version": 2}))
    np.savez(path, **arrays)
    found = checkpoints.load(path, config, FRAMES).state
    assert found.scene.path_of.dtype == state.scene.path_of.dtype
    for new, old in zip(with_paths(found), with_paths(state), strict=True):
        np.testing.assert_array_equal(new.paths[found.scene.path_of], old.paths[path_of])


def test_members_with_fewer_paths_than_others_get_unused_ones(tracked):
    state = tracked[1]
    few, many = len(state.scene.params.paths), 2 * len(state.scene.params.paths)
    wide = with_capacity(state, len(state.scene.alive), many)
    for before, after in zip(with_paths(state), with_paths(wide), strict=True):
        np.testing.assert_array_equal(after.paths[:few], before.paths)
        assert after.paths.shape[0] == many
        assert not after.paths[few:].any()


def test_the_outline_of_what_is_valid_does_not_move():
    split, _ = filmed(block=False)
    row, column = np.ogrid[:HEIGHT, :WIDTH]
    lens = np.hypot(row - HEIGHT / 2, column - WIDTH / 2) < 0.45 * HEIGHT
    images = np.where(lens[..., None], split.images, 0).astype(np.float16)
    valid = np.broadcast_to(lens, images.shape[:3]).copy()
    assert not len(find_seeds(surfaces(), dataclasses.replace(split, images=images, valid=valid), KNOTS, MANY).points)
