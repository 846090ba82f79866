"""Scenes in the layout of Nerfies: cameras, sizes, lists, instants and points; and the demo, which is one."""

import json

import numpy as np
import pytest
from scenes import edit_json, write_image, write_json, write_nerfies

from l2dgs_jax import data
from l2dgs_jax.config import PRESETS
from l2dgs_jax.data import clouds, demo, images, nerfies

LENS = {
    "focal_length": 110.0,
    "pixel_aspect_ratio": 1.1,
    "skew": 1.5,
    "principal_point": [50.0, 33.0],
    "radial_distortion": [-0.12, 0.05, -0.01],
    "tangential": [0.02, -0.01],
    "image_size": [96, 72],
}


def lens_projection(camera: dict, points: np.ndarray) -> np.ndarray:
    """The projection of Nerfies' camera files: pixels of unscaled world points."""
    local = (points - np.array(camera["position"])) @ np.array(camera["orientation"]).T
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    k, p, r2 = camera["radial_distortion"], camera.get("tangential", camera.get("tangential_distortion")), x * x + y * y
    d = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
    lens_x = x * d + 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x)
    lens_y = y * d + 2 * p[1] * x * y + p[0] * (r2 + 2 * y * y)
    f, (u, v) = camera["focal_length"], camera["principal_point"]
    return np.stack([f * lens_x + camera["skew"] * lens_y + u, f * camera["pixel_aspect_ratio"] * lens_y + v], -1)


def pinhole_projection(split, index, points):
    viewmat, K = split.cameras.viewmat[index], split.cameras.K[index]
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    return (local @ K.T)[:, :2] / local[:, 2:]


def read_camera(scene, name):
    return json.loads((scene / "camera" / f"{name}.json").read_text())


@pytest.mark.parametrize("downscale", [1, 2, 3])
def test_cameras_project_as_nerfies_does(tmp_path, downscale):
    scene = write_nerfies(tmp_path, principal_point=[14.0, 13.5], pixel_aspect_ratio=1.2)
    dataset = data.load_dataset(scene, downscale)
    stored = np.load(scene / "points.npy").astype(float)
    for split in (dataset.train, dataset.test):
        for index, name in enumerate(split.names):
            expected = lens_projection(read_camera(scene, name), stored) / downscale
            np.testing.assert_allclose(pinhole_projection(split, index, dataset.points), expected, atol=1e-3)


def test_the_world_can_stay_as_stored(tmp_path):
    scene = write_nerfies(tmp_path, center=(0.5, -1.0, 2.0), scale=0.25)
    stored = np.load(scene / "points.npy")
    kept, moved = (data.load_dataset(scene, normalise=normalise) for normalise in (False, True))
    np.testing.assert_allclose(kept.points, stored, rtol=1e-6)
    np.testing.assert_allclose(moved.points, (stored - [0.5, -1.0, 2.0]) * 0.25, atol=1e-6)
    np.testing.assert_allclose(
        pinhole_projection(kept.train, 1, kept.points), pinhole_projection(moved.train, 1, moved.points), atol=1e-3
    )
    assert not PRESETS["paper"].normalise
    assert PRESETS["default"].normalise


def test_the_dense_cloud_of_4dgaussians_is_preferred(tmp_path):
    scene = write_nerfies(tmp_path, center=(0.5, -1.0, 2.0), scale=0.25)
    points, colors = np.random.default_rng(0).random((2, 60, 3)).astype(np.float32)
    clouds.write_ply(scene / nerfies.DENSE_CLOUD, points, colors)
    dataset = data.load_dataset(scene)
    np.testing.assert_allclose(dataset.points, (points - [0.5, -1.0, 2.0]) * 0.25, atol=1e-6)
    np.testing.assert_allclose(dataset.colors, colors, atol=1 / 255)
    (scene / "points.npy").unlink()
    assert len(data.load_dataset(scene).points) == 60


def test_undistorted_dots_lie_where_the_pinhole_projects(tmp_path):
    scene = write_nerfies(tmp_path, num_frames=5, width=96, height=72, val_every=None, **LENS)
    camera = read_camera(scene, "000000")
    # Points whose dots spread over the picture, one per picture of the same camera.
    rotation, depth = np.array(camera["orientation"]), 3.0
    local = np.array([[x, y, 1.0] for x in (-0.35, 0.0, 0.33) for y in (-0.21, 0.0, 0.24)]) * depth
    points = local @ rotation + np.array(camera["position"])
    dots = lens_projection(camera, points)
    columns, rows = np.meshgrid(np.arange(96) + 0.5, np.arange(72) + 0.5)
    plain = lens_projection(camera | {"radial_distortion": [0] * 3, "tangential": [0] * 2, "skew": 0.0}, points)
    assert np.abs(plain - dots).max() > 1  # the lens matters

    for point, dot in zip(points, dots, strict=True):
        blob = np.exp(-((columns - dot[0]) ** 2 + (rows - dot[1]) ** 2) / (2 * 2.0**2))
        write_image(scene / "rgb" / "1x" / "000000.png", np.repeat((blob * 60000).astype(np.uint16)[..., None], 3, -1))
        np.save(scene / "points.npy", point[None])
        (scene / "points_rgb.npy").unlink(missing_ok=True)
        dataset = data.load_dataset(scene)
        seen = dataset.train.images[0, ..., 0].astype(float)
        centre = [(seen * columns).sum() / seen.sum(), (seen * rows).sum() / seen.sum()]
        np.testing.assert_allclose(centre, pinhole_projection(dataset.train, 0, dataset.points)[0], atol=0.1)
        assert dataset.train.cameras.K[0, 0, 1] == 0


def test_stored_smaller_pictures_are_undistorted_like_averaged_ones(tmp_path):
    scene = write_nerfies(tmp_path, width=96, height=72, **LENS)
    averaged = data.load_dataset(scene, 2)
    for path in (scene / "rgb" / "1x").iterdir():
        small = images.area_average(images.read_image(path), 2)
        write_image(scene / "rgb" / "2x" / path.name, small)
    stored = data.load_dataset(scene, 2)
    assert np.array_equal(stored.train.cameras.K, averaged.train.cameras.K)
    assert np.abs(stored.train.images - averaged.train.images).mean() < 2e-3


def test_coarsest_fitting_size_is_read_and_the_rest_averaged(scene):
    for path in (scene / "rgb" / "1x").iterdir():
        write_image(scene / "rgb" / "2x" / path.name, np.ones((12, 16, 3)))
    assert data.load_dataset(scene, 1).train.images.max() < 0.5
    for downscale in (2, 4, 6):
        dataset = data.load_dataset(scene, downscale)
        assert np.all(dataset.train.images == 1)
        assert dataset.train.images.shape[1:3] == (dataset.height, dataset.width) == (24 // downscale, 32 // downscale)
    assert data.load_dataset(scene, 3).train.images.max() < 0.5


def test_points_splits_and_times_are_read(scene):
    dataset = data.load_dataset(scene)
    assert dataset.test.names == ("000002", "000006")
    assert dataset.train.names == ("000000", "000001", "000003", "000004", "000005", "000007")
    np.testing.assert_allclose(dataset.train.cameras.time, np.array([0, 1, 3, 4, 5, 7]) / 7, rtol=1e-6)
    assert np.abs(dataset.points).max() <= 1.001  # center and scale undone
    for split in (dataset.train, dataset.test):
        assert [x.dtype for x in split.cameras] == [np.float32] * 3
        assert split.images.dtype == np.float16


def test_time_id_or_order_replaces_a_missing_warp_id(scene):
    expected = np.array([0, 1, 3, 4, 5, 7]) / 7
    write_json(scene / "metadata.json", {f"{i:06d}": {"time_id": 3 + 2 * i} for i in range(8)})
    np.testing.assert_allclose(data.load_dataset(scene).train.cameras.time, expected, rtol=1e-6)
    (scene / "metadata.json").unlink()
    np.testing.assert_allclose(data.load_dataset(scene).train.cameras.time, expected, rtol=1e-6)


@pytest.mark.parametrize("num_frames", [5, 8, 9, 10])
def test_clips_without_held_out_frames_are_split_by_the_rule_of_4dgs(tmp_path, num_frames):
    dataset = data.load_dataset(write_nerfies(tmp_path, num_frames, val_every=None))
    train = [i for i in range(num_frames) if i % 4 == 0]
    assert [int(name) for name in dataset.train.names] == train
    assert [int(name) for name in dataset.test.names] == [i + 2 for i in train][:-1]
    assert dataset.notes == (f"{2 * len(train) - 1} of {num_frames} frames are used (held-out rule 4dgs)",)


def test_split_files_replace_a_missing_dataset_json(scene):
    expected = data.load_dataset(scene)
    lists = json.loads((scene / "dataset.json").read_text())
    (scene / "dataset.json").unlink()
    write_json(scene / "splits" / "train.json", {"frame_names": lists["train_ids"]})
    write_json(scene / "splits" / "val.json", {"frame_names": lists["val_ids"]})
    dataset = data.load_dataset(scene)
    assert (dataset.train.names, dataset.test.names) == (expected.train.names, expected.test.names)


def test_point_colors_from_a_file_or_from_columns(scene):
    expected = np.load(scene / "points_rgb.npy") / 255
    np.testing.assert_allclose(data.load_dataset(scene).colors, expected, rtol=1e-6)
    for values in (expected, expected * 255):
        np.save(scene / "points_rgb.npy", values)
        np.testing.assert_allclose(data.load_dataset(scene).colors, expected, rtol=1e-6)
    (scene / "points_rgb.npy").unlink()
    points = np.load(scene / "points.npy")
    assert data.load_dataset(scene).colors is None
    np.save(scene / "points.npy", np.concatenate([points, 255 * expected], 1))
    np.testing.assert_allclose(data.load_dataset(scene).colors, expected, rtol=1e-6)


def test_optional_files_and_keys_have_defaults(scene):
    (scene / "scene.json").unlink()
    for path in (scene / "camera").iterdir():
        edit_json(path, skew=None, pixel_aspect_ratio=None, radial_distortion=None, tangential_distortion=None)
    dataset = data.load_dataset(scene)
    np.testing.assert_array_equal(dataset.points, np.load(scene / "points.npy"))
    np.testing.assert_allclose(dataset.train.cameras.K[0], [[38.4, 0, 16], [0, 38.4, 12], [0, 0, 1]], rtol=1e-6)


def test_demo_loads_and_is_small():
    dataset = data.load_dataset("demo", 2)
    assert (dataset.width, dataset.height) == (128, 96)
    assert 0.05 < dataset.train.images.mean() < 0.25  # dark
    assert len(dataset.test.names) >= 5
    assert len(dataset.points) == len(dataset.colors) > 1000
    assert sum(path.stat().st_size for path in demo.FOLDER.rglob("*") if path.is_file()) < 4e6
    assert "MIT License" in (demo.FOLDER / "LICENSE").read_text()
    pixels = pinhole_projection(dataset.train, 0, dataset.points)
    assert np.mean(np.all((pixels > 0) & (pixels < [128, 96]), -1)) > 0.3
