"""Points added by optical flow on static surfaces: wall, floor and board of a clip in which a square moves."""

import dataclasses
import functools
import sys

import numpy as np
import pytest
from clips import FOCAL, HEIGHT, WIDTH, clip
from tiny_training import make_dataset, tiny

from l2dgs_jax.cameras.epipolar import EpipolarGeometry, epipolar_geometry, project
from l2dgs_jax.cameras.flow import pixel_indices
from l2dgs_jax.cameras.geometry import project_points
from l2dgs_jax.config import overrides
from l2dgs_jax.data import Dataset, Split
from l2dgs_jax.training import initial_state, surfaces
from l2dgs_jax.training.initial_state import SPARSE_POINTS
from l2dgs_jax.training.surfaces import depth_maps, find_surfaces, fused, thinned, triangulated
from l2dgs_jax.types import Camera

COUNT, MANY = 10, 40_000
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float32)
SQUARE_AT = -0.5  # depth of the moving square


def sparse():
    """A few points on the wall and the floor, as structure from motion may find in the dark."""
    rng = np.random.default_rng(0)
    wall = np.concatenate([rng.uniform((-2, -1), (2, 0.8), (30, 2)), np.full((30, 1), 2.0)], axis=-1)
    floor = rng.uniform((-1, 1, -0.5), (1, 1, 2), (30, 3))
    return np.concatenate([wall, floor]).astype(np.float32)


@functools.cache
def filmed(light=0.2, noise=0.0, block=True):
    pictures, views, squares = clip(COUNT, reach=0.3, light=light, block=block)
    cameras = Camera(
        np.stack(views).astype(np.float32),
        np.tile(K, (COUNT, 1, 1)),
        np.linspace(0, 1, COUNT, dtype=np.float32),
    )
    images = np.clip(np.stack(pictures) + np.random.default_rng(0).normal(0, noise, np.shape(pictures)), 0, 1)
    return Split(tuple(map(str, range(COUNT))), cameras, images.astype(np.float16)), np.stack(squares)


@functools.cache
def maps(noise=0.0):
    return depth_maps(sparse(), filmed(noise=noise)[0])


@functools.cache
def found(noise=0.0):
    return fused(sparse(), maps(noise), MANY)


def distance_to_surfaces(points):
    """Distances of points from the nearest static surface of the clip."""
    x, y, z = points.T
    board = np.maximum(np.abs(x - 0.7), np.abs(y - 0.3)) < 0.65
    return np.minimum(np.minimum(np.abs(z - 2), np.abs(y - 1)), np.where(board, np.abs(z - 0.6), np.inf))


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_added_points_lie_on_surfaces(noise):
    distances = distance_to_surfaces(found(noise))
    assert len(distances) > 1000
    assert np.median(distances) < 0.03
    assert np.quantile(distances, 0.95) < 0.15  # the camera is 3.5 to 5.5 away from the surfaces


def test_no_points_are_added_on_the_moving_square():
    above_floor = np.abs(found()[:, 1] - 1) > 0.2
    assert np.mean(above_floor & (np.abs(found()[:, 2] - SQUARE_AT) < 0.3)) < 0.01


@pytest.mark.parametrize("frame", [3, 5, 8])
def test_points_cover_the_static_parts_of_a_frame(frame):
    split, squares = filmed()
    pixels, _ = project_points(found(), split.cameras.viewmat[frame], split.cameras.K[frame])
    inside = ((pixels >= 0) & (pixels < (WIDTH, HEIGHT))).all(-1)
    cells = np.zeros((HEIGHT // 6, WIDTH // 6), bool)
    column, row = (pixels[inside] // 6).astype(int).T
    cells[row, column] = True
    still = ~squares[frame].reshape(HEIGHT // 6, 6, WIDTH // 6, 6).any((1, 3))
    assert cells[still].mean() > 0.8


def test_few_points_are_added_where_there_are_points_already():
    again = fused(np.concatenate([sparse(), found()]), maps(), MANY)
    assert len(again) < 0.2 * len(found())


def test_the_number_of_added_points_is_limited():
    limited = fused(sparse(), maps(), 200)
    assert 0 < len(limited) <= 200
    assert len(find_surfaces(sparse(), filmed()[0], 0)) == 0


def test_invalid_pixels_get_no_points():
    split, _ = filmed()
    valid = np.ones(split.images.shape[:3], bool)
    valid[..., : WIDTH // 2] = False
    half = find_surfaces(sparse(), dataclasses.replace(split, valid=valid), MANY)
    pixels, _ = project_points(half, split.cameras.viewmat[5], split.cameras.K[5])
    assert len(half) > 100
    assert np.mean(pixels[:, 0] < WIDTH / 2 - 30) < 0.05


def test_the_outline_of_what_is_valid_gives_no_points():
    """Where a camera circles a thing, what stays at its place in the picture looks like something at its depth."""
    split, _ = filmed()
    row, column = np.ogrid[:HEIGHT, :WIDTH]
    lens = np.hypot(row - HEIGHT / 2, column - WIDTH / 2) < 0.45 * HEIGHT
    valid = np.broadcast_to(lens, split.images.shape[:3]).copy()
    images = np.where(lens[..., None], split.images, 0).astype(np.float16)
    points = find_surfaces(sparse(), dataclasses.replace(split, images=images, valid=valid), MANY)
    assert len(points) > 1000
    assert np.mean(distance_to_surfaces(points) > 0.15) < 0.12  # 0.04 if the same pixels are valid but none is black


@pytest.mark.parametrize("turned", [0.0, 0.05])
def test_cameras_in_one_place_give_no_points(turned):
    split, _ = filmed(block=False)
    angles = turned * np.arange(COUNT)
    viewmat = np.tile(split.cameras.viewmat[5], (COUNT, 1, 1)).astype(np.float64)
    turns = np.tile(np.eye(4), (COUNT, 1, 1))
    turns[:, 0, 0] = turns[:, 2, 2] = np.cos(angles)
    turns[:, 0, 2], turns[:, 2, 0] = np.sin(angles), -np.sin(angles)
    cameras = split.cameras._replace(viewmat=(turns @ viewmat).astype(np.float32))
    assert len(find_surfaces(sparse(), dataclasses.replace(split, cameras=cameras), MANY)) == 0


def test_without_known_points_in_view_none_are_added():
    behind = sparse() * np.float32([1, 1, 0]) - np.float32([0, 0, 20])
    assert len(find_surfaces(behind, filmed()[0], MANY)) == 0


def test_noise_alone_gives_no_points():
    split, _ = filmed()
    images = np.random.default_rng(1).uniform(0, 0.1, split.images.shape).astype(np.float16)
    assert len(find_surfaces(sparse(), dataclasses.replace(split, images=images), MANY)) < 0.05 * len(found())


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_triangulation_finds_depths_in_spite_of_false_matches(scale):
    split, _ = filmed()
    viewmat = split.cameras.viewmat.astype(np.float64)
    viewmat[:, :3, 3] *= scale
    cameras = split.cameras._replace(viewmat=viewmat)
    others = [1, 3, 6, 9]
    geometries = [epipolar_geometry(cameras, 5, other) for other in others]
    truth = np.linspace(1 / 6, 1 / 2, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) / scale
    pixels = pixel_indices(HEIGHT, WIDTH) + 0.5
    matches = np.stack([project(geometry, pixels, truth) for geometry in geometries]).astype(np.float32)
    matches[1, :60] += 15  # false matches in one view
    trusted = np.ones(matches.shape[:3], bool)
    trusted[2:, 120:] = False
    trusted[1:, 150:] = False  # a single match is not enough
    geometry = EpipolarGeometry(*map(np.stack, zip(*geometries, strict=True)))
    depth = triangulated(geometry, matches, trusted, (0.01 / scale, 2 / scale))
    assert np.isnan(depth[150:]).all()
    assert np.isfinite(depth[:150]).mean() > 0.99
    np.testing.assert_allclose(depth[:150], truth[:150], rtol=1e-3)


@pytest.mark.parametrize("illumination", [None, 0.5])
def test_training_starts_from_the_added_points_too(monkeypatch, illumination):
    dataset = make_dataset()
    dataset = dataclasses.replace(dataset, colors=np.full(dataset.points.shape, 0.5))
    added = np.random.default_rng(0).uniform([-1, -0.7, 2], [1, 0.7, 3], (7, 3)).astype(np.float32)
    monkeypatch.setattr(sys.modules[initial_state.__module__], "find_surfaces", lambda *_, most: added[:most])
    config = tiny()
    model = dataclasses.replace(config.model, surfaces=True, initial_illumination=illumination)
    after = initial_state(dataset, dataclasses.replace(config, model=model)).scene
    assert int(after.alive.sum()) == len(dataset.points) + len(added)
    means = np.asarray(after.params.gaussians.means[after.alive])
    assert all(np.isclose(means, point, atol=1e-6).all(-1).any() for point in added)


def test_thinned_points_have_less_noise():
    rng = np.random.default_rng(0)
    noisy = np.column_stack([rng.uniform(-1, 1, (5000, 2)), rng.normal(0, 0.02, 5000)])
    few = thinned(noisy, 1000)
    assert few.shape == (1000, 3)
    assert few[:, 2].std() < 0.6 * noisy[:, 2].std()
    np.testing.assert_allclose(few.std(0)[:2], noisy.std(0)[:2], rtol=0.05)
    assert thinned(noisy[:3], 1000).shape == (3, 3)


@pytest.mark.parametrize("enough", [True, False])
def test_random_points_give_way_to_surfaces(monkeypatch, enough):
    split, _ = filmed()
    random = np.random.default_rng(0).uniform((-2, -1, -1), (2, 1, 3), (900, 3)).astype(np.float32)
    dataset = Dataset("cloudless", WIDTH, HEIGHT, split, split, random, points_are_random=True)
    module, behind = sys.modules[initial_state.__module__], []
    if not enough:
        monkeypatch.setattr(module, "find_surfaces", lambda *_, **__: found()[:400])
    monkeypatch.setattr(module, "find_seeds", lambda points, *_: behind.append(points))
    config = overrides.replace(tiny(), {"model.surfaces": True, "model.tracks": True, "density.max_gaussians": 6000})
    scene = initial_state(dataset, config).scene
    means = np.asarray(scene.params.gaussians.means[scene.alive])
    if enough:
        assert len(behind[0]) == SPARSE_POINTS < len(means) <= 6000
        for points in (means, behind[0]):
            assert np.quantile(distance_to_surfaces(points), 0.9) < 0.15
    else:
        assert len(means) == 900
        assert behind[0] is random


def test_depth_maps_are_computed_for_at_most_max_frames(monkeypatch):
    monkeypatch.setattr(surfaces, "MAX_FRAMES", 4)
    split, _ = filmed()
    np.testing.assert_allclose([m.viewmat for m in depth_maps(sparse(), split)], split.cameras.viewmat[[0, 3, 6, 9]])


def test_a_camera_may_move_slowly(monkeypatch):
    monkeypatch.setattr(surfaces, "MAX_FRAMES", 4)
    count = 80
    pictures, views, _ = clip(count, reach=0.1, light=0.2)
    times = np.linspace(0, 1, count, dtype=np.float32)
    cameras = Camera(np.stack(views).astype(np.float32), np.tile(K, (count, 1, 1)), times)
    slow = Split(tuple(map(str, range(count))), cameras, np.stack(pictures).astype(np.float16))
    assert np.mean([np.isfinite(depths.inverse) for depths in depth_maps(sparse(), slow)]) > 0.5
