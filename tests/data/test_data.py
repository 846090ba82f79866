import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scenes import GAIN, edit_json, write_image, write_json, write_nerfies

from l2dgs_jax import data
from l2dgs_jax.data import demo, images
from l2dgs_jax.errors import UserError

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


@pytest.fixture
def scene(tmp_path):
    return write_nerfies(tmp_path / "scene")


@pytest.mark.parametrize("downscale", [1, 2, 3])
def test_cameras_project_as_nerfies_does(tmp_path, downscale):
    scene = write_nerfies(tmp_path, principal_point=[14.0, 13.5], pixel_aspect_ratio=1.2)
    dataset = data.load_dataset(scene, downscale)
    stored = np.load(scene / "points.npy").astype(float)
    for split in (dataset.train, dataset.test):
        for index, name in enumerate(split.names):
            expected = lens_projection(read_camera(scene, name), stored) / downscale
            np.testing.assert_allclose(pinhole_projection(split, index, dataset.points), expected, atol=1e-3)


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


def test_lens_of_a_smaller_stored_size_is_the_same_lens(tmp_path):
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


def test_area_average_crops_and_averages():
    image = np.random.default_rng(0).random((7, 8, 3), np.float32)
    small = images.area_average(image, 3)
    assert small.shape == (2, 2, 3)
    np.testing.assert_allclose(small[1, 0], image[3:6, :3].mean((0, 1)), rtol=1e-6)


@pytest.mark.parametrize("channels", [None, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_images_of_any_depth_and_channels(tmp_path, dtype, channels):
    shape = (5, 6) if channels is None else (5, 6, channels)
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)
    if channels == 4:
        pixels[0, :, 3] = 0  # colour under alpha 0 must survive
    write_image(tmp_path / "a.png", pixels)
    expected = np.repeat(pixels[..., None], 3, -1) if channels is None else pixels[..., :3]
    np.testing.assert_allclose(images.read_image(tmp_path / "a.png"), expected / np.iinfo(dtype).max, atol=1e-6)
    assert images.read_header(tmp_path / "a.png") == ((6, 5), False, False)


def test_truth_and_masks(tmp_path):
    dataset = data.load_dataset(write_nerfies(tmp_path, truth=True), 2)
    for split in (dataset.train, dataset.test):
        assert split.masks.dtype == bool
        assert split.masks.shape == split.images.shape[:3]
        assert 0 < split.masks.mean() < 0.5
        np.testing.assert_allclose(split.welllit, GAIN * split.images.astype(float), atol=GAIN / 255)


def test_mask_is_a_majority(tmp_path):
    scene = write_nerfies(tmp_path, truth=True)
    mask = np.zeros((24, 32))
    mask[:2, :2], mask[0, 2:4] = [[1, 1], [1, 0]], 1  # three of four, two of four
    for path in (scene / "mask" / "1x").iterdir():
        write_image(path, mask)
    masks = data.load_dataset(scene, 2).train.masks
    assert masks[:, 0, 0].all()
    assert masks.sum() == len(masks)


def test_truth_of_one_split_only(tmp_path):
    scene = write_nerfies(tmp_path, truth=True)
    for name in data.load_dataset(scene).train.names:
        (scene / "well" / "1x" / f"{name}.png").unlink()
    shutil.rmtree(scene / "mask")
    dataset = data.load_dataset(scene)
    assert dataset.train.welllit is None
    assert dataset.test.welllit is not None
    assert dataset.test.masks is None


def test_scene_files_split_and_time(scene):
    dataset = data.load_dataset(scene)
    assert dataset.test.names == ("000002", "000006")
    assert dataset.train.names == ("000000", "000001", "000003", "000004", "000005", "000007")
    np.testing.assert_allclose(dataset.train.cameras.time, np.array([0, 1, 3, 4, 5, 7]) / 7, rtol=1e-6)
    assert np.abs(dataset.points).max() <= 1.001  # center and scale undone
    for split in (dataset.train, dataset.test):
        assert [x.dtype for x in split.cameras] == [np.float32] * 3
        assert split.images.dtype == np.float16


def test_time_id_and_order_stand_in_for_warp_id(scene):
    expected = np.array([0, 1, 3, 4, 5, 7]) / 7
    write_json(scene / "metadata.json", {f"{i:06d}": {"time_id": 3 + 2 * i} for i in range(8)})
    np.testing.assert_allclose(data.load_dataset(scene).train.cameras.time, expected, rtol=1e-6)
    (scene / "metadata.json").unlink()
    np.testing.assert_allclose(data.load_dataset(scene).train.cameras.time, expected, rtol=1e-6)


@pytest.mark.parametrize("num_frames", [5, 8, 9, 10])
def test_rule_for_clips_without_held_out_frames(tmp_path, num_frames):
    dataset = data.load_dataset(write_nerfies(tmp_path, num_frames, val_every=None))
    train = [i for i in range(num_frames) if i % 4 == 0]
    assert [int(name) for name in dataset.train.names] == train
    assert [int(name) for name in dataset.test.names] == [i + 2 for i in train][:-1]
    assert dataset.notes == (f"{2 * len(train) - 1} of {num_frames} frames are used (held-out rule 4dgs)",)


def test_split_files_stand_in_for_lists(scene):
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


def rotation_with(value):
    matrix = np.eye(3)
    matrix[0, 0] = value
    return matrix.tolist()


def truncate(path):
    path.write_bytes(path.read_bytes()[:-200])


def one_frame(scene):
    edit_json(scene / "dataset.json", ids=["000000"], train_ids=["000000"], val_ids=[])


def damage(path, **changes):
    return lambda scene: edit_json(scene / path, **changes)


def points(values):
    return lambda scene: np.save(scene / "points.npy", values)


CAMERA = "camera/000003.json"
PICTURE = "rgb/1x/000003.png"
FAULTS = {
    "empty folder": ("scene: the folder is empty", lambda s: [shutil.rmtree(s), s.mkdir()]),
    "unknown layout": ("scene: not a known layout", lambda s: shutil.rmtree(s / "camera")),
    "no folder": ("scene: no such folder", shutil.rmtree),
    "no lists": ("dataset.json: no such file", lambda s: (s / "dataset.json").unlink()),
    "lists without a key": ("dataset.json: 'train_ids' is missing", damage("dataset.json", ids=None, train_ids=None)),
    "list of another type": ("dataset.json: 'val_ids' is 3", damage("dataset.json", val_ids=3)),
    "malformed JSON": ("dataset.json: cannot be read as JSON", lambda s: (s / "dataset.json").write_text('{"ids": [')),
    "JSON of another type": ("dataset.json: holds a JSON list", lambda s: write_json(s / "dataset.json", [])),
    "binary JSON": (f"{CAMERA}: cannot be read as JSON", lambda s: (s / CAMERA).write_bytes(b"\xff\xfe\x00")),
    "one frame": ("dataset.json: 1 frames to train with and 0 held out", one_frame),
    "nothing to train": ("dataset.json: 0 frames to train", damage("dataset.json", train_ids=[])),
    "frame without instant": ("metadata.json: '000007' is missing", damage("metadata.json", **{"000007": None})),
    "instant of another type": ("metadata.json: 'warp_id'", damage("metadata.json", **{"000001": {"warp_id": "x"}})),
    "no pictures": ("rgb: no such folder", lambda s: shutil.rmtree(s / "rgb")),
    "pictures too small": ("rgb: holds 2x; expected", lambda s: (s / "rgb" / "1x").rename(s / "rgb" / "2x")),
    "no sizes": ("rgb: holds no folder like 1x", lambda s: (s / "rgb" / "1x").rename(s / "rgb" / "full")),
    "camera without picture": (f"{PICTURE}: no such file", lambda s: (s / PICTURE).unlink()),
    "frame without camera": (f"{CAMERA}: no such file", lambda s: (s / CAMERA).unlink()),
    "truth with a gap": ("well/1x/000003.png: no such file", lambda s: (s / "well/1x/000003.png").unlink()),
    "truncated picture": (f"{PICTURE}: expected a readable", lambda s: truncate(s / PICTURE)),
    "text for a picture": (f"{PICTURE}: expected a readable", lambda s: (s / PICTURE).write_text("dark")),
    "empty picture": (f"{PICTURE}: expected a readable", lambda s: (s / PICTURE).write_bytes(b"")),
    "picture of another size": (
        f"{PICTURE}: the picture is 30x24 pixels; expected 32x24",
        lambda s: write_image(s / PICTURE, np.zeros((24, 30, 3))),
    ),
    "mask of another size": ("mask/1x/000003.png: the", lambda s: write_image(s / "mask/1x/000003.png", np.eye(9))),
    "camera of another size": (f"{CAMERA}: the image size is 16x12", damage(CAMERA, image_size=[16, 12])),
    "fractional size": (f"{CAMERA}: 'image_size'", damage(CAMERA, image_size=[32.5, 24])),
    "missing key": (f"{CAMERA}: 'position' is missing", damage(CAMERA, position=None)),
    "NaN in a pose": (f"{CAMERA}: 'position' is", damage(CAMERA, position=[0, float("nan"), 0])),
    "infinite rotation": (f"{CAMERA}: 'orientation' is", damage(CAMERA, orientation=rotation_with(float("inf")))),
    "vector of another length": (f"{CAMERA}: 'position' is", damage(CAMERA, position=[0, 0])),
    "ragged matrix": (f"{CAMERA}: 'orientation' is", damage(CAMERA, orientation=[[1, 0, 0], [0, 1], [0, 0, 1]])),
    "reflection": (f"{CAMERA}: 'orientation' is no rotation", damage(CAMERA, orientation=rotation_with(-1))),
    "stretched rotation": (f"{CAMERA}: 'orientation' is no rotation", damage(CAMERA, orientation=rotation_with(1.1))),
    "no focal length": (f"{CAMERA}: 'focal_length' is 0.0", damage(CAMERA, focal_length=0)),
    "no aspect": (f"{CAMERA}: 'focal_length'", damage(CAMERA, pixel_aspect_ratio=0)),
    "flat scene": ("scene.json: 'scale' is 0.0", damage("scene.json", scale=0)),
    "scene without a centre": ("scene.json: 'center' is missing", damage("scene.json", center=None)),
    "no points": ("points.npy: no such file", lambda s: (s / "points.npy").unlink()),
    "zero points": ("points.npy: the array has shape", points(np.zeros((0, 3)))),
    "points of another shape": ("points.npy: the array has shape", points(np.zeros((4, 2)))),
    "points as a scalar": ("points.npy: the array has shape", points(np.float32(0))),
    "NaN in the points": ("points.npy: holds NaN", points(np.full((4, 3), np.nan))),
    "objects for points": ("points.npy: not a NumPy array", points(np.array([[None] * 3]))),
    "text for points": ("points.npy: not a NumPy array of numbers", points(np.array([["a"] * 3]))),
    "truncated points": ("points.npy: not a NumPy array", lambda s: truncate(s / "points.npy")),
    "empty points": ("points.npy: not a NumPy array", lambda s: (s / "points.npy").write_bytes(b"")),
    "colours of another length": ("points_rgb.npy: the", lambda s: np.save(s / "points_rgb.npy", np.zeros((2, 3)))),
    "colours out of range": ("points_rgb.npy: colours", lambda s: np.save(s / "points_rgb.npy", np.full((60, 3), -1))),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_in_one_sentence(tmp_path, fault):
    message, spoil = FAULTS[fault]
    scene = write_nerfies(tmp_path / "scene", truth=True)
    data.load_dataset(scene)
    spoil(scene)
    with pytest.raises(UserError) as caught:
        data.load_dataset(scene)
    text = str(caught.value)
    assert message in text
    assert "expected" in text
    assert "\n" not in text


@pytest.mark.parametrize("downscale", [-1, 0, 25, 1000])
def test_downscale_out_of_range(scene, downscale):
    with pytest.raises(UserError, match=f"--downscale {downscale}: expected"):
        data.load_dataset(scene, downscale)


def test_scene_that_is_a_file(tmp_path):
    (tmp_path / "clip.mp4").write_bytes(b"")
    with pytest.raises(UserError, match=r"clip.mp4: no such folder"):
        data.load_dataset(tmp_path / "clip.mp4")


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


def test_pixels_of_alpha_0_do_not_count(tmp_path):
    scene = write_nerfies(tmp_path)
    pixels = np.full((24, 32, 4), 0.5)
    pixels[:, 0, 3] = 0
    write_image(scene / "rgb" / "1x" / "000003.png", pixels)
    dataset = data.load_dataset(scene, 2)
    third = dataset.train.names.index("000003")
    assert dataset.test.valid is None
    assert not dataset.train.valid[third, :, 0].any()  # half of each of these pixels is marked
    assert dataset.train.valid.sum() == dataset.train.valid.size - 12
    np.testing.assert_allclose(dataset.train.images[third].astype(float), 128 / 255, atol=1e-3)


@pytest.mark.parametrize("downscale", [1, 2])
def test_pixels_that_the_lens_never_saw_do_not_count(tmp_path, downscale):
    assert (
        data.load_dataset(write_nerfies(tmp_path / "barrel", radial_distortion=[-0.2, 0, 0]), downscale).train.valid
        is None
    )
    scene = write_nerfies(tmp_path / "cushion", radial_distortion=[0.3, 0, 0])
    x, y = (np.arange(32) + 0.5 - 16)[None] / 38.4, (np.arange(24) + 0.5 - 12)[:, None] / 38.4
    factor = 1 + 0.3 * (x**2 + y**2)
    inside = (np.abs(x * factor) <= 16 / 38.4) & (np.abs(y * factor) <= 12 / 38.4)
    expected = inside.reshape(24 // downscale, downscale, 32 // downscale, downscale).all((1, 3))
    assert 0 < expected.mean() < 1
    for split in (data.load_dataset(scene, downscale).train, data.load_dataset(scene, downscale).test):
        np.testing.assert_array_equal(split.valid, np.broadcast_to(expected, split.valid.shape))


def test_covisible_masks(tmp_path):
    scene = write_nerfies(tmp_path)
    mask = np.zeros((12, 16))
    mask[:, :6] = 1
    for name in ("000002", "000006"):
        write_image(scene / "covisible" / "2x" / "val" / f"{name}.png", mask)
    dataset = data.load_dataset(scene, 2)
    assert dataset.train.covisible is None
    assert dataset.test.covisible.dtype == bool
    np.testing.assert_array_equal(dataset.test.covisible, np.broadcast_to(mask > 0, (2, 12, 16)))


def test_truth_and_masks_of_no_fitting_scale_are_mentioned(tmp_path):
    scene = write_nerfies(tmp_path, truth=True)
    for kind in ("well", "mask"):
        (scene / kind / "1x").rename(scene / kind / "2x")
        for path in (scene / kind / "2x").iterdir():
            write_image(path, np.ones((12, 16, 3)))
    (scene / "covisible").mkdir()
    dataset = data.load_dataset(scene)
    for split in (dataset.train, dataset.test):
        assert (split.welllit, split.masks, split.covisible) == (None, None, None)
    assert sorted(dataset.notes) == [
        "covisible/ holds no folder like 1x: not used at --downscale 1",
        "mask/ holds 2x: not used at --downscale 1",
        "well/ holds 2x: not used at --downscale 1",
    ]
    assert data.load_dataset(scene, 2).train.masks.all()


def test_masks_of_some_frames_only_are_mentioned(tmp_path):
    scene = write_nerfies(tmp_path, truth=True)
    (scene / "mask" / "1x" / "000003.png").unlink()
    dataset = data.load_dataset(scene)
    assert dataset.train.masks is None
    assert dataset.test.masks is not None
    assert dataset.notes == ("mask/1x/ has pictures of 5 of 6 frames, but not of '000003': not used",)


def test_pictures_that_differ_in_their_suffix_only(tmp_path):
    scene = write_nerfies(tmp_path / "scene", 9)
    expected = data.load_dataset(scene)
    for kind, layout in data.LAYOUTS.items():
        layout.write(expected, tmp_path / kind)
        root = tmp_path / kind / ("rgb/1x" if kind == "nerfies" else "images")
        write_image(root / "000003.jpg", np.ones((24, 32, 3)))
        if kind in ("colmap", "transforms"):  # these say which is meant
            assert data.load_dataset(tmp_path / kind).train.images.max() < 0.5
        else:
            with pytest.raises(UserError, match=r"000003\.jpg: is 000003\.png under another suffix; expected one"):
                data.load_dataset(tmp_path / kind)


@pytest.mark.parametrize("call", ["iterdir", "is_dir"])
def test_a_folder_that_cannot_be_listed(scene, monkeypatch, call):
    def refuse(path, *_):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, call, refuse)
    with pytest.raises(UserError, match=r"scene.*: Permission denied; expected files that can be read"):
        data.load_dataset(scene)


def test_layouts_are_told_apart_and_can_be_named(tmp_path):
    scene = write_nerfies(tmp_path / "scene", 9)
    other = data.load_dataset(scene)
    data.LAYOUTS["transforms"].write(other, tmp_path / "other")
    for path in (tmp_path / "other").iterdir():
        shutil.move(path, scene / path.name)
    with pytest.raises(UserError, match="scene: holds the layouts nerfies and transforms; expected one, or --format"):
        data.load_dataset(scene)
    assert (
        data.load_dataset(scene, format="nerfies").test.names
        == data.load_dataset(scene, format="transforms").test.names
    )
    for name, wanted in (("colmap", "sparse/0: no such model"), ("llff", "poses_bounds.npy: no such file")):
        with pytest.raises(UserError, match=wanted):
            data.load_dataset(scene, format=name)
    with pytest.raises(UserError, match="--format nonsuch: no such layout; expected auto, nerfies"):
        data.load_dataset(scene, format="nonsuch")


def test_frames_to_hold_out_can_be_chosen(scene):
    assert data.load_dataset(scene, held_out="4").test.names == ("000000", "000004")
    with pytest.raises(UserError, match="--held-out 1: expected"):
        data.load_dataset(scene, held_out="1")


def test_a_zip_archive_is_named_as_such(scene):
    shutil.make_archive(str(scene), "zip", scene)
    with pytest.raises(UserError, match=r"scene\.zip: is a zip archive; expected a folder: unpack it first"):
        data.load_dataset(f"{scene}.zip")


def test_a_scene_beyond_single_precision_is_refused(scene):
    np.save(scene / "points.npy", np.full((60, 3), 1e200))
    with pytest.raises(UserError, match="scene: a point holds values beyond 1e18"):
        data.load_dataset(scene)
    np.save(scene / "points.npy", np.ones((60, 3)))
    edit_json(scene / CAMERA, position=[0, 1e300, 0])
    with pytest.raises(UserError, match=f"{CAMERA}: the camera holds values beyond"):
        data.load_dataset(scene)
