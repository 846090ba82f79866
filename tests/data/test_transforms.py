"""Scenes in the layouts of Blender, D-NeRF, instant-ngp and nerfstudio."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scenes import edit_json, write_image, write_json, write_nerfies

from l2dgs_jax import data
from l2dgs_jax.data import clouds, colmap, llff, transforms
from l2dgs_jax.data.lens import Lens, undistort
from l2dgs_jax.errors import UserError


def camera_to_world(angle, distance=4.0):
    """A camera on a circle around (1, 2, 3), looking at its centre, with OpenGL's axes."""
    back = np.array([np.sin(angle), 0.3, np.cos(angle)]) / np.hypot(1, 0.3)
    right = np.cross([0, 1, 0], back) / np.linalg.norm(np.cross([0, 1, 0], back))
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = np.stack([right, np.cross(back, right), back], -1), distance * back + [1, 2, 3]
    return world


@pytest.fixture
def blender(tmp_path):
    """A scene as D-NeRF has them: RGBA pictures named without a suffix, no points, three files."""
    for part, count in (("train", 5), ("val", 2), ("test", 3)):
        frames = []
        for i in range(count):
            pixels = np.zeros((12, 16, 4))
            pixels[..., 0], pixels[2:, :, 3], pixels[2, :, 3] = 0.8, 1, 0.5
            write_image(tmp_path / part / f"r_{i:03d}.png", pixels)
            frames.append(
                {
                    "file_path": f"./{part}/r_{i:03d}",
                    "rotation": 0.1,
                    "time": i / (count - 1),
                    "transform_matrix": camera_to_world(0.5 * i + len(part)).tolist(),
                }
            )
        write_json(tmp_path / f"transforms_{part}.json", {"camera_angle_x": 0.7, "frames": frames})
    return tmp_path


@pytest.fixture
def studio(tmp_path):
    """A scene as nerfstudio has them, without its lists."""
    transforms.write(data.load_dataset(write_nerfies(tmp_path / "nerfies", 9)), tmp_path / "scene")
    edit_json(tmp_path / "scene" / "transforms.json", train_filenames=None, val_filenames=None, test_filenames=None)
    return tmp_path / "scene"


def edit_frames(scene, **changes):
    frames = json.loads((scene / "transforms.json").read_text())["frames"]
    merged = [{k: v for k, v in (frame | changes).items() if v is not None} for frame in frames]
    edit_json(scene / "transforms.json", frames=merged)


def test_a_blender_scene_is_read(blender):
    dataset = data.load_dataset(blender)
    assert dataset.train.names == tuple(f"train/r_{i:03d}" for i in range(5))
    assert dataset.test.names == tuple(f"test/r_{i:03d}" for i in range(3))
    np.testing.assert_allclose(dataset.test.cameras.time, [0, 0.5, 1])
    focal = 8 / np.tan(0.35)
    np.testing.assert_allclose(dataset.train.cameras.K[0], [[focal, 0, 8], [0, focal, 6], [0, 0, 1]], rtol=1e-6)
    # In OpenGL's axes a point before the camera has negative z, one above it positive y.
    world = camera_to_world(0.5 * 2 + 5)
    seen = dataset.train.cameras.viewmat[2] @ world @ [0.3, 0.5, -2, 1]
    np.testing.assert_allclose(seen, [0.3, -0.5, 2, 1], atol=1e-5)


def test_alpha_is_composited_over_black(blender):
    image = data.load_dataset(blender).train.images[0, ..., 0].astype(float)
    np.testing.assert_allclose(image[:2], 0)
    np.testing.assert_allclose(image[2], 204 / 255 * 128 / 255, atol=1e-3)
    np.testing.assert_allclose(image[3:], 204 / 255, atol=1e-3)
    assert data.load_dataset(blender).train.valid is None


def test_without_a_cloud_random_points_fill_a_box_where_the_cameras_look(blender):
    dataset = data.load_dataset(blender)
    assert "no point cloud" in dataset.notes[0]
    assert dataset.points.shape == (clouds.RANDOM_POINTS, 3)
    assert dataset.points_are_random
    half = clouds.BOX_OVER_DISTANCE * 4
    np.testing.assert_allclose(dataset.points.min(0), np.array([1, 2, 3]) - half, atol=0.01)
    np.testing.assert_allclose(dataset.points.max(0), np.array([1, 2, 3]) + half, atol=0.01)
    assert np.array_equal(dataset.points, data.load_dataset(blender).points)


@pytest.mark.parametrize("layout", [transforms, llff])
def test_random_points_are_not_written_as_a_cloud(blender, tmp_path, layout):
    written = tmp_path / "written"
    layout.write(data.load_dataset(blender), written)
    assert not list(written.glob("*.ply"))
    assert data.load_dataset(written).points_are_random


def test_points_beside_the_scene_are_found(blender):
    points = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    clouds.write_ply(blender / "points3d.ply", points, None)
    dataset = data.load_dataset(blender)
    assert np.array_equal(dataset.points, points)
    assert not dataset.points_are_random
    assert dataset.colors is None
    assert dataset.notes == ()


def test_points_of_a_colmap_model_beside_transforms_json_are_not_used(studio, tmp_path):
    colmap.write(data.load_dataset(tmp_path / "nerfies"), tmp_path / "colmap")
    (tmp_path / "colmap" / "sparse").rename(studio / "sparse")
    (studio / "points3D.ply").unlink()
    edit_json(studio / "transforms.json", ply_file_path=None)
    dataset = data.load_dataset(studio, format="transforms")
    assert len(dataset.points) == clouds.RANDOM_POINTS
    assert "no point cloud" in dataset.notes[0]


def test_val_replaces_a_missing_test_file_and_a_rule_replaces_both(blender):
    (blender / "transforms_test.json").unlink()
    assert data.load_dataset(blender).test.names == ("val/r_000", "val/r_001")
    (blender / "transforms_val.json").unlink()
    assert data.load_dataset(blender).test.names == ("train/r_000",)


def test_a_nerfstudio_scene_without_lists_or_times_is_read(studio):
    expected = data.load_dataset(studio)
    assert expected.test.names == ("000000", "000008")
    edit_frames(studio, time=None)
    np.testing.assert_allclose(data.load_dataset(studio).train.cameras.time, np.arange(1, 8) / 8, rtol=1e-6)
    edit_frames(studio, time=None, fl_x=None, fl_y=None, cx=None, cy=None)
    edit_json(studio / "transforms.json", fl_x=38.4, cx=16.0)
    loaded = data.load_dataset(studio)
    np.testing.assert_allclose(loaded.train.cameras.K, expected.train.cameras.K, rtol=1e-6)


def test_the_lists_of_a_nerfstudio_scene_are_used(studio):
    edit_json(
        studio / "transforms.json",
        train_filenames=["images/000001.png", "images/000002.png"],
        val_filenames=["images/000005.png"],
    )
    dataset = data.load_dataset(studio)
    assert (dataset.train.names, dataset.test.names) == (("000001", "000002"), ("000005",))
    assert data.load_dataset(studio, held_out="3").test.names == ("000000", "000003", "000006")
    edit_json(studio / "transforms.json", test_filenames=[])
    assert data.load_dataset(studio).test.names == ("000005",)
    edit_json(studio / "transforms.json", train_filenames=None)
    assert data.load_dataset(studio).test.names == ("000005",)
    assert len(data.load_dataset(studio).train.names) == 8


def test_smaller_copies_of_the_pictures_are_used(studio):
    for path in (studio / "images").iterdir():
        write_image(studio / "images_4" / path.name, np.ones((6, 8, 3)))
    assert data.load_dataset(studio, 2).train.images.max() < 0.5
    assert np.all(data.load_dataset(studio, 4).train.images == 1)


def test_pictures_of_a_fisheye_are_undistorted(studio):
    pinhole = data.load_dataset(studio).train
    edit_json(studio / "transforms.json", camera_model="OPENCV_FISHEYE", k1=0.1)
    found = data.load_dataset(studio).train.images
    for picture, K, straight in zip(pinhole.images, pinhole.cameras.K, found, strict=True):
        expected = undistort(picture.astype(np.float32), K, Lens(radial=(0.1,), fisheye=True))
        np.testing.assert_allclose(straight, np.clip(expected, 0, 1), atol=2e-3)
    assert np.abs(found - pinhole.images).max() > 0.02


def test_pictures_outside_the_scene_have_names_that_stay_inside(studio, tmp_path):
    expected = data.load_dataset(studio)
    (studio / "images").rename(tmp_path / "frames")
    (studio / "images").mkdir()
    frames = json.loads((studio / "transforms.json").read_text())["frames"]
    for i, frame in enumerate(frames):
        place = ("../frames", tmp_path / "frames", "images/../../frames")[i % 3]
        frame["file_path"] = frame["file_path"].replace("images", str(place))
    edit_json(studio / "transforms.json", frames=frames)
    dataset = data.load_dataset(studio)
    assert dataset.train.names == tuple(f"frames/{name}" for name in expected.train.names)
    assert np.array_equal(dataset.train.images, expected.train.images)
    transforms.write(dataset, tmp_path / "written" / "scene")
    assert [path.name for path in (tmp_path / "written").iterdir()] == ["scene"]
    escaping = replace(dataset, train=replace(dataset.train, names=("../x", *dataset.train.names[1:])))
    with pytest.raises(UserError, match=r"frame '../x': .* expected"):
        transforms.write(escaping, tmp_path / "escaped")
    assert not (tmp_path / "escaped").exists()


def test_frames_with_the_same_name_are_refused(blender):
    write_image(blender / "train" / "r_001.jpg", np.zeros((12, 16, 3)))
    for listed, message in (("train", "frames .* are both"), ("test", "frames .* are both 'train/r_001'")):
        path = blender / f"transforms_{listed}.json"
        content = json.loads(path.read_text())
        duplicate = {**content["frames"][0], "file_path": "train/r_001.jpg"}
        edit_json(path, frames=[*content["frames"], duplicate])
        with pytest.raises(UserError, match=rf"{listed}\.json: {message}.*; expected names that differ"):
            data.load_dataset(blender)
        write_json(path, content)


def change(**changes):
    return lambda scene: edit_json(scene / "transforms.json", **changes)


def change_frames(**changes):
    return lambda scene: edit_frames(scene, **changes)


FAULTS = {
    "no frames": ("transforms.json: 'frames' is missing", change(frames=None)),
    "an empty list": ("0 frames to train with", change(frames=[])),
    "a frame of another type": ("frame 0 is no JSON object", change(frames=[3])),
    "a frame without a file": ("'file_path' is missing", change_frames(file_path=None)),
    "a missing picture": ("000003.png: no such file", lambda s: (s / "images" / "000003.png").unlink()),
    "a name too long for a file": (": no such file", change_frames(file_path="a" * 5000)),
    "a frame without a pose": ("'transform_matrix' is missing", change_frames(transform_matrix=None)),
    "a stretched pose": (
        "'transform_matrix' is not a rotation",
        change_frames(transform_matrix=(2 * np.eye(4)).tolist()),
    ),
    "a projective pose": ("the last row of", change_frames(transform_matrix=[*np.eye(4)[:3].tolist(), [0, 0, 1, 1]])),
    "no focal length": ("has no positive focal length", change_frames(fl_x=None, fl_y=None)),
    "a panorama": ("'camera_model' is 'EQUIRECTANGULAR'", change(camera_model="EQUIRECTANGULAR")),
    "another size": ("the picture is 32x24 pixels; expected 64x48", change(w=64, h=48)),
    "a time for some": (
        "'time' is missing",
        lambda s: edit_json(
            s / "transforms.json",
            frames=[
                {k: v for k, v in frame.items() if i or k != "time"}
                for i, frame in enumerate(json.loads((s / "transforms.json").read_text())["frames"])
            ],
        ),
    ),
    "a list of unknown frames": ("is not among its frames", change(frames=[], train_filenames=["images/000001.png"])),
    "no such cloud": ("nonsuch.ply: no such file", change(ply_file_path="nonsuch.ply")),
    "a damaged cloud": ("points3D.ply: not a PLY", lambda s: (s / "points3D.ply").write_bytes(b"ply\nend_header\n")),
    "a truncated cloud": (
        "points3D.ply: not a PLY",
        lambda s: (s / "points3D.ply").write_bytes((s / "points3D.ply").read_bytes()[:-5]),
    ),
    "a cloud of too many points": (
        "points3D.ply: not a PLY",
        lambda s: (s / "points3D.ply").write_bytes(
            (s / "points3D.ply").read_bytes().replace(b"element vertex ", b"element vertex 9" + 20 * b"9", 1)
        ),
    ),
    "cameras that look nowhere in common": (
        "the cameras look at no common place",
        lambda s: [
            edit_frames(s, transform_matrix=np.eye(4).tolist()),
            edit_json(s / "transforms.json", ply_file_path=None),
            (s / "points3D.ply").unlink(),
        ],
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_in_one_sentence(studio, fault):
    message, spoil = FAULTS[fault]
    data.load_dataset(studio)
    spoil(studio)
    with pytest.raises(UserError) as caught:
        data.load_dataset(studio)
    assert message in str(caught.value)
    assert "expected" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_clouds_of_any_format_are_read(tmp_path, form):
    rng = np.random.default_rng(0)
    points, paint = rng.normal(size=(4, 3)), rng.integers(0, 256, (4, 3), np.uint8)
    head = f"ply\nformat {form} 1.0\ncomment é x\nelement vertex 4\n"
    head += "".join(f"property double {a}\nproperty float n{a}\n" for a in "xyz")
    head += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    head += "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    order = {"binary_big_endian": ">", "binary_little_endian": "<"}.get(form, "")
    if order:
        kind = [(f"{n}{a}", f"{order}{t}") for a in "xyz" for n, t in (("", "f8"), ("n", "f4"))]
        rows = np.zeros(4, kind + [(c, "u1") for c in ("red", "green", "blue")])
        for i, axis in enumerate("xyz"):
            rows[axis], rows[("red", "green", "blue")[i]] = points[:, i], paint[:, i]
        body = rows.tobytes()
    else:
        lines = (
            " ".join(f"{x!r} 0" for x in map(float, p)) + " " + " ".join(map(str, c))
            for p, c in zip(points, paint, strict=True)
        )
        body = "\n".join(lines).encode()
    (tmp_path / "cloud.ply").write_bytes(head.encode() + body)
    read, colors = clouds.read_ply(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(read, points)
    np.testing.assert_allclose(colors, paint / 255, rtol=1e-6)


def test_masks_that_are_named_say_which_pixels_count(studio):
    mask = np.ones((24, 32))
    mask[:10] = 0
    write_image(studio / "masks" / "m.png", mask)
    assert data.load_dataset(studio).train.valid is None
    edit_frames(studio, mask_path="masks/m.png")
    dataset = data.load_dataset(studio, 2)
    assert np.all(dataset.train.valid == (np.arange(12) >= 5)[:, None])
    edit_frames(studio, mask_path="masks/nonsuch.png")
    with pytest.raises(UserError, match=r"nonsuch\.png: no such file"):
        data.load_dataset(studio)


def test_depth_that_is_not_read_is_mentioned(studio):
    edit_frames(studio, depth_file_path="depths/1.png")
    assert any("'depth_file_path' is not read" in note for note in data.load_dataset(studio).notes)


def test_truth_is_composited_over_black_like_its_input(studio):
    covered = np.dstack([np.full((24, 32, 3), 0.8), np.tile(np.arange(32) < 16, (24, 1))])
    dataset = data.load_dataset(studio)
    for name in (*dataset.train.names, *dataset.test.names):
        write_image(studio / "images" / f"{name}.png", covered)
        write_image(studio / "well" / "1x" / f"{name}.png", covered)
    dataset = data.load_dataset(studio)
    np.testing.assert_array_equal(dataset.train.welllit, dataset.train.images)
    assert dataset.train.welllit[..., 16:, :].max() == 0
