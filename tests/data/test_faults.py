"""Whatever is wrong with a scene, the error message is one sentence."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scenes import edit_json, write_image, write_json, write_nerfies

from l2dgs_jax import data
from l2dgs_jax.errors import UserError


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
    "reflection": (f"{CAMERA}: 'orientation' is not a rotation", damage(CAMERA, orientation=rotation_with(-1))),
    "stretched rotation": (
        f"{CAMERA}: 'orientation' is not a rotation",
        damage(CAMERA, orientation=rotation_with(1.1)),
    ),
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
def test_a_downscale_out_of_range_is_refused(scene, downscale):
    with pytest.raises(UserError, match=f"--downscale {downscale}: expected"):
        data.load_dataset(scene, downscale)


def test_a_scene_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "clip.mp4").write_bytes(b"")
    with pytest.raises(UserError, match=r"clip.mp4: no such folder"):
        data.load_dataset(tmp_path / "clip.mp4")


@pytest.mark.parametrize("call", ["iterdir", "is_dir"])
def test_a_folder_that_cannot_be_listed_is_reported(scene, monkeypatch, call):
    def refuse(path, *_):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, call, refuse)
    with pytest.raises(UserError, match=r"scene.*: Permission denied; expected files that can be read"):
        data.load_dataset(scene)


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


@pytest.mark.parametrize("offset", [1e3, 1e7])
def test_a_scene_far_from_its_origin_is_refused_if_rounding_would_blur_it(scene, offset):
    """As in coordinates of a map; those of a surveyed site do no harm."""
    np.save(scene / "points.npy", np.load(scene / "points.npy").astype(float) + offset)
    for path in (scene / "camera").iterdir():
        edit_json(path, position=[x + offset for x in json.loads(path.read_text())["position"]])
    if offset < 1e4:
        data.load_dataset(scene)
    else:
        with pytest.raises(UserError, match=r"scene: its coordinates, of up to 5e\+06, are too large .* by .* pixels"):
            data.load_dataset(scene)
