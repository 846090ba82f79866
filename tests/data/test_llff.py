"""Scenes in the layout of LLFF."""

import shutil

import numpy as np
import pytest
from scenes import write_image, write_nerfies

from l2dgs_jax import data
from l2dgs_jax.data import clouds, colmap, llff
from l2dgs_jax.errors import UserError


@pytest.fixture
def scene(tmp_path):
    llff.write(data.load_dataset(write_nerfies(tmp_path / "nerfies", 9)), tmp_path / "scene")
    for name in ("dataset.json", "metadata.json"):
        (tmp_path / "scene" / name).unlink()
    return tmp_path / "scene"


def edit(scene, row, column, value):
    rows = np.load(scene / "poses_bounds.npy")
    rows[row, column] = value
    np.save(scene / "poses_bounds.npy", rows)


def test_axes_are_down_right_back(scene):
    rows = np.load(scene / "poses_bounds.npy")
    down, right, back, position, (height, width, focal) = rows[1, :15].reshape(3, 5).T
    assert (height, width) == (24, 32)
    dataset = data.load_dataset(scene)
    viewmat, K = dataset.train.cameras.viewmat[0], dataset.train.cameras.K[0]
    assert dataset.train.names[0] == "000001"
    seen = viewmat @ np.append(position + 0.2 * right + 0.3 * down - 2 * back, 1)
    np.testing.assert_allclose(seen, [0.2, 0.3, 2, 1], atol=1e-5)
    np.testing.assert_allclose(K, [[focal, 0, 16], [0, focal, 12], [0, 0, 1]], rtol=1e-6)


def test_every_eighth_frame_is_held_out(scene):
    assert data.load_dataset(scene).test.names == ("000000", "000008")


def test_random_points_lie_between_the_bounds_of_some_view(scene):
    (scene / "points3D.ply").unlink()
    bounds = np.load(scene / "poses_bounds.npy")[:, 15:]
    dataset = data.load_dataset(scene)
    assert "no point cloud" in dataset.notes[0]
    assert len(dataset.points) == clouds.RANDOM_POINTS
    assert dataset.points_are_random
    seen = np.zeros(clouds.RANDOM_POINTS, bool)
    for split in (dataset.train, dataset.test):
        for viewmat, K in zip(split.cameras.viewmat, split.cameras.K, strict=True):
            local = dataset.points @ viewmat[:3, :3].T + viewmat[:3, 3]
            pixel = (local @ K.T)[:, :2] / local[:, 2:]
            within = (local[:, 2] > bounds[:, 0].min() - 1e-3) & (local[:, 2] < bounds[:, 1].max() + 1e-3)
            seen |= within & np.all((pixel > -0.01) & (pixel < [32.01, 24.01]), -1)
    assert seen.all()


def test_points_of_a_colmap_model_in_the_scene_are_used(scene, tmp_path):
    colmap.write(data.load_dataset(tmp_path / "nerfies"), tmp_path / "colmap")
    shutil.copytree(tmp_path / "colmap" / "sparse", scene / "sparse")
    (scene / "points3D.ply").unlink()
    assert np.array_equal(data.load_dataset(scene).points, data.load_dataset(tmp_path / "colmap").points)
    forced = data.load_dataset(scene, format="llff")
    assert np.array_equal(forced.points, data.load_dataset(tmp_path / "colmap").points)
    assert forced.notes == ()


FAULTS = {
    "another shape": ("poses_bounds.npy: the array has shape", lambda s: np.save(s / "poses_bounds.npy", np.eye(5))),
    "not an array": ("not a NumPy array", lambda s: (s / "poses_bounds.npy").write_text("x")),
    "a picture too few": ("has 9 poses for the 8 pictures", lambda s: (s / "images" / "000003.png").unlink()),
    "a picture too many": ("9 poses for the 10", lambda s: write_image(s / "images" / "z.png", np.zeros((24, 32, 3)))),
    "no pictures": ("images: no such folder", lambda s: shutil.rmtree(s / "images")),
    "bounds the wrong way": ("row 2: size 32.0x24.0, focal length 38.4", lambda s: edit(s, 2, 16, 1e-3)),
    "no focal length": ("row 2: size", lambda s: edit(s, 2, 14, 0)),
    "a stretched pose": ("row 2: the pose is not a rotation", lambda s: edit(s, 2, 0, 9)),
    "NaN": ("holds NaN", lambda s: edit(s, 2, 0, np.nan)),
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


def test_poses_belong_to_the_pictures_in_the_order_of_their_files(scene):
    """As COLMAP and LLFF sort them: with their suffix, so that a space comes before a dot."""
    expected = data.load_dataset(scene).train
    for old, new in (("000001", "b (1)"), ("000002", "b (2)"), ("000003", "b")):
        (scene / "images" / f"{old}.png").rename(scene / "images" / f"{new}.png")
    for i in (0, 4, 5, 6, 7, 8):
        (scene / "images" / f"{i:06d}.png").rename(scene / "images" / f"{'a' if i < 1 else 'c'}{i}.png")
    found = data.load_dataset(scene).train
    assert found.names[:3] == ("b (1)", "b (2)", "b")
    np.testing.assert_array_equal(found.images, expected.images)
    np.testing.assert_array_equal(found.cameras.viewmat, expected.cameras.viewmat)


def test_smaller_copies_that_are_numbered_belong_to_the_pictures_in_order(scene):
    for i in range(9):
        write_image(scene / "images_2" / f"image{i:03d}.png", np.full((12, 16, 3), i / 10))
    dataset = data.load_dataset(scene, 2)
    assert [round(10 * image.mean().item()) for image in dataset.train.images] == [1, 2, 3, 4, 5, 6, 7]
    (scene / "images_2" / "image003.png").unlink()
    with pytest.raises(UserError, match="images_2: holds 8 pictures, but none for 7 of the 7 frames"):
        data.load_dataset(scene, 2)
