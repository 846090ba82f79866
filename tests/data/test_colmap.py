"""Scenes with a COLMAP model."""

import shutil
import struct

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest
from scenes import mark_orientation, write_image, write_nerfies
from scipy.spatial.transform import Rotation

from l2dgs_jax import data
from l2dgs_jax.data import colmap, colmap_model, images
from l2dgs_jax.data.lens import distort
from l2dgs_jax.data.pictures import by_name
from l2dgs_jax.errors import UserError

WIDTH, HEIGHT = 96, 72
PARAMS = {
    "SIMPLE_PINHOLE": [100, 47, 37],
    "PINHOLE": [100, 103, 47, 37],
    "SIMPLE_RADIAL": [100, 47, 37, 0.1],
    "RADIAL": [100, 47, 37, -0.1, 0.05],
    "OPENCV": [100, 103, 47, 37, -0.12, 0.05, 0.01, -0.02],
    "FULL_OPENCV": [100, 103, 47, 37, 0.1, 0.05, 0.01, -0.02, 0.01, 0.02, -0.03, 0.01],
    "OPENCV_FISHEYE": [100, 103, 47, 37, 0.05, -0.02, 0.01, 0.003],
    "SIMPLE_RADIAL_FISHEYE": [100, 47, 37, 0.05],
    "RADIAL_FISHEYE": [100, 47, 37, 0.05, -0.02],
}
# One point for each frame, spread over the picture.
POINTS = np.array([[x, y, 1.0] for x in (-0.25, 0.0, 0.3) for y in (-0.17, 0.0, 0.19)]) * 3


def reconstruction(model):
    """A pycolmap model of one camera and a frame for each of POINTS, all at the same place."""
    pycolmap = pytest.importorskip("pycolmap")
    sfm_model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=3, model=model, width=WIDTH, height=HEIGHT, params=PARAMS[model])
    sfm_model.add_camera_with_trivial_rig(camera)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(Rotation.from_rotvec([0.01, -0.02, 0.1]).as_quat()), [0.02, -0.03, 0.3])
    for i, point in enumerate(POINTS):
        image = pycolmap.Image(name=f"frame {i}.png", camera_id=3, image_id=i + 1)
        sfm_model.add_image_with_trivial_frame(image, pose)
        sfm_model.add_point3D(point, pycolmap.Track(), np.full(3, 10 * i + 1, np.uint8))
    return sfm_model


def write_scene(folder, sfm_model, form):
    """A scene whose frame i shows point i through the lens, as a blurred dot."""
    model_folder = folder / "sparse" / "0"
    model_folder.mkdir(parents=True)
    {"binary": sfm_model.write_binary, "text": sfm_model.write_text}[form](str(model_folder))
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    for i, point in enumerate(POINTS):
        x, y = sfm_model.images[i + 1].project_point(point)
        blob = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 1.3**2))
        write_image(folder / "images" / f"frame {i}.png", np.repeat((60000 * blob).astype(np.uint16)[..., None], 3, -1))
    return folder


@pytest.mark.parametrize("form", ["binary", "text"])
@pytest.mark.parametrize("model", PARAMS)
def test_projections_agree_with_colmaps_own_and_with_the_undistorted_pictures(tmp_path, model, form):
    sfm_model = reconstruction(model)
    scene = write_scene(tmp_path / "scene", sfm_model, form)
    camera = colmap_model.read_cameras(scene / "sparse" / "0")[3]
    K, lens = colmap.pinhole_and_lens(camera)
    image = colmap_model.read_images(scene / "sparse" / "0")[0]
    local = POINTS @ image.viewmat[:3, :3].T + image.viewmat[:3, 3]
    distorted = np.stack(distort(lens, local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]), -1)
    expected = np.array([sfm_model.images[1].project_point(point) for point in POINTS])
    np.testing.assert_allclose(distorted @ K[:2, :2].T + K[:2, 2], expected, atol=1e-9)

    dataset = data.load_dataset(scene)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    for split in (dataset.train, dataset.test):
        for i, name in enumerate(split.names):
            viewmat, K = split.cameras.viewmat[i], split.cameras.K[i]
            x, y, z = K @ (viewmat[:3, :3] @ POINTS[int(name[-1])] + viewmat[:3, 3])
            seen = split.images[i, ..., 0].astype(float)
            centre = [(seen * columns).sum() / seen.sum(), (seen * rows).sum() / seen.sum()]
            np.testing.assert_allclose(centre, [x / z, y / z], atol=0.05)
    np.testing.assert_allclose(dataset.points, POINTS, rtol=1e-6)
    np.testing.assert_allclose(dataset.colors[:, 0] * 255, 10 * np.arange(9) + 1, rtol=1e-5)


@pytest.fixture
def scene(tmp_path):
    dataset = data.load_dataset(write_nerfies(tmp_path / "nerfies", 10))
    colmap.write(dataset, tmp_path / "scene")
    for name in ("dataset.json", "metadata.json"):
        (tmp_path / "scene" / name).unlink()
    return tmp_path / "scene"


def test_every_eighth_frame_is_held_out_and_numbers_in_names_are_instants(scene):
    dataset = data.load_dataset(scene)
    assert dataset.test.names == ("000000", "000008")
    np.testing.assert_allclose(dataset.train.cameras.time, np.array([1, 2, 3, 4, 5, 6, 7, 9]) / 9, rtol=1e-6)
    assert data.load_dataset(scene, held_out="4dgs").test.names == ("000002", "000006")
    assert data.load_dataset(scene, held_out="5").test.names == ("000000", "000005")


@pytest.mark.parametrize("place", ["images", ".", "low light é"])
def test_pictures_are_found_where_users_keep_them(scene, place):
    expected = data.load_dataset(scene)
    shutil.move(scene / "images", scene.parent / "pictures")
    (scene / place).mkdir(exist_ok=True)
    for path in (scene.parent / "pictures").iterdir():
        shutil.move(path, scene / place / path.name)
    for path in (scene / "sparse" / "0").iterdir():
        shutil.move(path, scene / "sparse" / path.name)
    (scene / "sparse" / "0").rmdir()
    assert np.array_equal(data.load_dataset(scene).train.images, expected.train.images)
    for path in (scene / place).glob("*.png"):
        write_image(scene.parent / "scene_2" / path.name, np.ones((12, 16, 3)))  # another scene
    assert data.load_dataset(scene, 2).train.images.max() < 0.5


def test_other_folders_than_images_do_not_stand_in_for_it(scene):
    shutil.copytree(scene / "images", scene / "masks")
    (scene / "images" / "000000.png").unlink()
    with pytest.raises(UserError, match=r"images: holds 9 pictures, but none for 1 of the \d frames, such as '000000'"):
        data.load_dataset(scene)
    shutil.rmtree(scene / "images")
    (scene / "masks" / "000000.png").unlink()
    with pytest.raises(UserError, match=r"images: no such folder"):
        data.load_dataset(scene)


def test_folders_that_could_both_be_meant_are_named(scene):
    shutil.move(scene / "images", scene / "frames")
    shutil.copytree(scene / "frames", scene / "masks")
    with pytest.raises(UserError, match=r"scene: frames/ and masks/ both hold pictures of all images"):
        data.load_dataset(scene)


def test_folders_of_smaller_copies_and_backups_are_not_mistaken(scene):
    expected = data.load_dataset(scene).train.images
    shutil.move(scene / "images", scene / "frames")
    shutil.copytree(scene / "frames", scene / "frames_2")
    assert np.array_equal(data.load_dataset(scene).train.images, expected)
    shutil.rmtree(scene / "frames_2")
    for path in (scene / "frames").iterdir():
        shutil.copyfile(path, scene / path.name)
    assert np.array_equal(data.load_dataset(scene).train.images, expected)


def test_names_may_be_relative_to_the_scene(scene):
    expected = data.load_dataset(scene)
    shutil.move(scene / "images", scene / "moved")
    (scene / "images").mkdir()
    shutil.move(scene / "moved", scene / "images" / "images")  # the model's names are relative to the outer one
    root = scene / "images"
    names = [f"images/{path.stem}" for path in (root / "images").iterdir()]
    assert colmap._root(root, names) == root
    assert expected.train.names[0] == "000001"


@pytest.mark.parametrize("orientation", [3, 6])
def test_pictures_are_as_stored_because_colmap_ignores_their_orientation(scene, orientation):
    expected = data.load_dataset(scene).train.images
    shutil.copytree(scene / "images", scene / "well" / "1x")
    for path in (*(scene / "images").iterdir(), *(scene / "well" / "1x").iterdir()):
        mark_orientation(path, orientation)
    assert images.read_header(path).orientation == orientation
    dataset = data.load_dataset(scene)
    assert np.array_equal(dataset.train.images, expected)
    assert np.array_equal(dataset.train.welllit, expected)


def test_pictures_of_upright_cameras_are_turned(scene):
    expected = data.load_dataset(scene).train.images
    for path in (scene / "images").iterdir():
        turned = np.rot90(oiio.ImageBuf(str(path)).get_pixels(oiio.UINT8))
        pixels = oiio.ImageBuf(np.ascontiguousarray(turned))
        pixels.specmod().attribute("Orientation", 6)
        assert pixels.write(str(path))
    assert np.array_equal(data.load_dataset(scene).train.images, expected)


def test_pictures_in_linked_folders_are_found(scene, tmp_path):
    expected = data.load_dataset(scene).train.images
    (scene / "images").rename(tmp_path / "elsewhere")
    (scene / "images").mkdir()
    (scene / "images" / "camera").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "back").symlink_to(scene / "images")
    assert sorted(by_name(scene / "images"))[0] == "camera/000000"
    (scene / "images" / "camera").rename(scene / "frames")
    (scene / "images").rmdir()
    assert np.array_equal(data.load_dataset(scene).train.images, expected)


def test_hidden_files_are_no_pictures(scene):
    expected = data.load_dataset(scene).train.images
    (scene / "images" / "._000000.png").write_bytes(b"made by another program")
    write_image(scene / "images" / ".thumbs" / "000000.png", np.ones((3, 4, 3)))
    assert np.array_equal(data.load_dataset(scene).train.images, expected)
    assert len(by_name(scene / "images")) == 10


def test_smaller_copies_of_the_pictures_are_used(scene):
    for path in (scene / "images").iterdir():
        write_image(scene / "images_2" / path.name, np.ones((12, 16, 3)))
    assert data.load_dataset(scene, 1).train.images.max() < 0.5
    assert np.all(data.load_dataset(scene, 2).train.images == 1)
    assert np.all(data.load_dataset(scene, 4).train.images == 1)


def test_a_second_model_is_mentioned(scene):
    assert data.load_dataset(scene).notes == ()
    shutil.copytree(scene / "sparse" / "0", scene / "sparse" / "1")
    assert "sparse/ also holds the models 1" in data.load_dataset(scene).notes[0]


def test_black_points_have_no_colours(scene):
    path = scene / "sparse" / "0" / "points3D.bin"
    count, size = struct.unpack("<Q", path.read_bytes()[:8])[0], struct.calcsize("<Q3d3BdQ")
    rows = bytearray(path.read_bytes())
    for i in range(count):
        at = 8 + i * size + 32
        rows[at : at + 3] = bytes(3)
    path.write_bytes(rows)
    assert data.load_dataset(scene).colors is None


def poke(kind, at, form, *values):
    """Overwrite bytes of a file of the model."""

    def change(scene):
        path = scene / "sparse" / "0" / f"{kind}.bin"
        content = bytearray(path.read_bytes())
        struct.pack_into(f"<{form}", content, at, *values)
        path.write_bytes(content)

    return change


def cut(kind, count):
    def change(scene):
        path = scene / "sparse" / "0" / f"{kind}.bin"
        path.write_bytes(path.read_bytes()[:count])

    return change


def text(kind, content):
    def change(scene):
        (scene / "sparse" / "0" / f"{kind}.bin").unlink()
        (scene / "sparse" / "0" / f"{kind}.txt").write_bytes(content.encode("latin-1"))

    return change


MODEL = "sparse/0"
FAULTS = {
    **{f"truncated {k}": (f"{k}.bin: ends within a record", cut(k, -9)) for k in ("cameras", "images", "points3D")},
    **{f"empty {k}": (f"{k}.bin: ends within a record", cut(k, 0)) for k in ("cameras", "images", "points3D")},
    "fewer points than there are": ("points3D.bin: 2805 bytes follow", poke("points3D", 0, "Q", 5)),
    "no points": ("points3D.bin: holds no points", lambda s: (s / MODEL / "points3D.bin").write_bytes(bytes(8))),
    "no file of points": ("points3D.bin: no such file", lambda s: (s / MODEL / "points3D.bin").unlink()),
    "NaN in a point": ("points3D.bin: holds points or", poke("points3D", 16, "d", np.nan)),
    "an unknown camera model": ("cameras.bin: the camera model number 77 is not", poke("cameras", 12, "i", 77)),
    "a camera of no size": ("cameras.bin: camera 1 has no valid size", poke("cameras", 16, "Q", 0)),
    "no focal length": ("camera 1 has no positive focal length", poke("cameras", 32, "d", 0.0)),
    "NaN in a camera": ("cameras.bin: camera 1 has no valid", poke("cameras", 32, "d", np.nan)),
    "a pose of zeros": ("images.bin: the pose of '000000.png'", poke("images", 12, "4d", 0, 0, 0, 0)),
    "an infinite position": ("images.bin: the pose of", poke("images", 44, "d", np.inf)),
    "a camera that is not there": ("'000000.png' has camera 9; expected", poke("images", 68, "I", 9)),
    "a name in another code": ("is not UTF-8", poke("images", 72, "B", 255)),
    "a missing picture": ("holds 9 pictures, but none for 1 of the 8", lambda s: (s / "images/000003.png").unlink()),
    "no pictures": ("images: no such folder", lambda s: shutil.rmtree(s / "images")),
    "an unknown model in text": ("camera model WIDE is not", text("cameras", "# c\n1 WIDE 32 24 1 2 3\n")),
    "too few parameters": ("has 2 parameters; expected 4 for PINHOLE", text("cameras", "1 PINHOLE 32 24 1 2\n")),
    "words for numbers": ("holds something else than numbers", text("cameras", "1 PINHOLE 32 x 1 2 3 4\n")),
    "half an image": ("images.txt: '1 1 0 0' is no image", text("images", "1 1 0 0\n\n")),
    "half a point": ("points3D.txt: '1 1 0 0' is no point", text("points3D", "1 1 0 0\n")),
    "text in another code": ("cameras.txt: is no text in UTF-8", text("cameras", "\xff\xfe")),
    "lists of other frames": (
        "dataset.json: lists 'nonsuch', which",
        lambda s: (s / "dataset.json").write_text('{"train_ids": ["nonsuch"], "val_ids": ["000000"]}'),
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_in_one_sentence(scene, fault):
    message, spoil = FAULTS[fault]
    data.load_dataset(scene)
    spoil(scene)
    with pytest.raises(UserError) as caught:
        data.load_dataset(scene)
    assert message in str(caught.value)
    assert "expected" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_text_with_comments_spaces_and_images_without_observations(scene):
    expected = data.load_dataset(scene)
    model_folder = scene / "sparse" / "0"
    images = colmap_model.read_images(model_folder)
    lines = ["# Image list with two lines of data per image:"]
    for i, (name, viewmat, camera) in enumerate(images):
        quat = Rotation.from_matrix(viewmat[:3, :3]).as_quat()[[3, 0, 1, 2]]
        values = " ".join(repr(float(x)) for x in (*quat, *viewmat[:3, 3]))
        lines += [f"{i + 1} {values} {camera} a  name {name}", "1.5 2.5 -1 3 4 7" if i % 2 else ""]
        (scene / "images" / name).rename(scene / "images" / f"a  name {name}")
    (model_folder / "images.bin").unlink()
    (model_folder / "images.txt").write_text("\n".join(lines) + "\n")
    dataset = data.load_dataset(scene)
    assert dataset.test.names == ("a  name 000000", "a  name 000008")
    np.testing.assert_allclose(dataset.train.cameras.viewmat, expected.train.cameras.viewmat, atol=1e-6)
