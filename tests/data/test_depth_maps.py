import shutil

import cv2
import numpy as np
import pytest
from scenes import write_image, write_nerfies
from scipy.spatial import cKDTree

from l2dgs_jax import data
from l2dgs_jax.cameras.flow import pixel_indices
from l2dgs_jax.cameras.geometry import project_points
from l2dgs_jax.data.stacks import MappedArray
from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.enhancement import enhanced
from l2dgs_jax.preprocess.lowlight import DarkeningConfig, darken

HEIGHT, WIDTH = 24, 32


def depth_of(name, height=HEIGHT, width=WIDTH):
    rng = np.random.default_rng(int(name))
    return rng.uniform(1, 5, (height, width)).astype(np.float32)


def write_depth(scene, names, kind="depth/1x", change=lambda depth: depth, suffix=".npy"):
    (scene / kind).mkdir(parents=True)
    for name in names:
        np.save(scene / kind / f"{name}{suffix}", change(depth_of(name)))
    return scene


@pytest.fixture
def scene(tmp_path):
    return write_nerfies(tmp_path / "scene")


def train_names(scene):
    return data.load_dataset(scene).train.names


def test_a_scene_without_depth_has_none(scene):
    dataset = data.load_dataset(scene)
    assert dataset.train.depths is None
    assert dataset.test.depths is None


@pytest.mark.parametrize("change", [lambda d: d, lambda d: d[..., None], lambda d: d.astype(np.float64)])
def test_depth_of_training_frames_is_read_in_the_layout_of_dycheck(scene, change):
    names = train_names(scene)
    dataset = data.load_dataset(write_depth(scene, names, change=change))
    assert dataset.notes == ()
    assert dataset.test.depths is None
    assert dataset.train.depths.dtype == np.float32
    np.testing.assert_allclose(dataset.train.depths, np.stack([depth_of(name) for name in names]), rtol=1e-6)


def test_disparity_is_read_as_inverse_depth_and_depth_is_preferred(scene):
    names = train_names(scene)
    write_depth(scene, names, "disparity/1x", lambda depth: 1 / depth)
    expected = np.stack([depth_of(name) for name in names])
    np.testing.assert_allclose(data.load_dataset(scene).train.depths, expected, rtol=1e-6)
    write_depth(scene, names, change=lambda depth: 2 * depth)
    np.testing.assert_allclose(data.load_dataset(scene).train.depths, 2 * expected, rtol=1e-6)


def test_16_bit_pictures_of_depth_are_read_up_to_scale(scene):
    names = train_names(scene)
    (scene / "depth" / "1x").mkdir(parents=True)
    for name in names:
        millimetres = np.rint(1000 * depth_of(name)).astype(np.uint16)
        millimetres[0, 0] = 0
        assert cv2.imwrite(str(scene / "depth" / "1x" / f"{name}.png"), millimetres)
    depths = data.load_dataset(scene).train.depths
    assert not depths[:, 0, 0].any()
    ratio = depths[:, 1:] / np.stack([depth_of(name) for name in names])[:, 1:]
    np.testing.assert_allclose(ratio, ratio[0, 0, 0], rtol=1e-3)


def test_a_downscaled_pixel_has_the_mean_inverse_depth_of_its_known_samples(scene):
    names = train_names(scene)

    def with_gaps(depth):
        depth[:2, :2] = [[np.nan, 0], [-1, np.inf]]
        depth[0, 2] = np.nan
        return depth

    depths = data.load_dataset(write_depth(scene, names, change=with_gaps), 2).train.depths
    samples = 1 / depth_of(names[0])
    np.testing.assert_allclose(1 / depths[0, 3, 5], samples[6:8, 10:12].mean(), rtol=1e-5)
    np.testing.assert_allclose(1 / depths[0, 0, 1], (samples[0, 3] + samples[1, 2] + samples[1, 3]) / 3, rtol=1e-5)
    assert depths[0, 0, 0] == 0
    assert (depths > 0).sum() == depths.size - len(names)


def test_depth_is_undistorted_like_pictures_but_not_interpolated(tmp_path):
    scene = write_nerfies(tmp_path, radial_distortion=[0.3, 0.0, 0.0])
    names = train_names(scene)
    steps = np.where(np.arange(WIDTH) < WIDTH // 2, 1, 4) * np.ones((HEIGHT, 1))
    dataset = data.load_dataset(write_depth(scene, names, change=lambda _: steps))
    np.testing.assert_array_equal(dataset.train.depths > 0, dataset.train.valid)
    assert not dataset.train.valid.all()
    assert set(np.unique(dataset.train.depths)) == {0, 1, 4}


def test_frames_without_depth_are_unknown_and_mentioned(scene):
    names = train_names(scene)
    dataset = data.load_dataset(write_depth(scene, names[:-2]))
    assert not dataset.train.depths[-2:].any()
    assert dataset.train.depths[:-2].all()
    assert dataset.notes == (f"depth/1x/ has depth of 4 of 6 frames, but not of '{names[-2]}': unknown there",)


@pytest.mark.parametrize(
    ("kind", "names", "note"),
    [
        ("depth/2x", ["000000"], "depth/ holds 2x: not used at --downscale 1"),
        ("disparity/1x", ["7"], "disparity/1x/ has depth of 0 of 6 frames, but not of '000000': unknown there"),
    ],
)
def test_depth_that_cannot_be_used_is_mentioned(scene, kind, names, note):
    dataset = data.load_dataset(write_depth(scene, names, kind))
    assert dataset.train.depths is None
    assert dataset.notes == (note,)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (np.ones((HEIGHT, WIDTH, 3)), r"000000.npy: the array has shape \(24, 32, 3\); expected \(H, W\)"),
        (np.ones(5), r"000000.npy: the array has shape \(5,\); expected"),
        (np.ones((12, 16)), r"000000.npy: the picture is 16x12 pixels; expected 32x24 pixels"),
        (np.array(["far"]), r"000000.npy: not a NumPy array of numbers; expected depth"),
    ],
)
def test_a_malformed_file_is_reported_in_one_sentence(scene, content, complaint):
    write_depth(scene, train_names(scene), change=lambda _: content)
    with pytest.raises(UserError, match=complaint):
        data.load_dataset(scene)


def test_depth_in_place_of_disparity_is_refused_and_vice_versa(tmp_path):
    """The maps show the distances of the points in view, or their inverse."""
    scene = write_nerfies(tmp_path, num_points=400)
    dataset = data.load_dataset(scene)
    for kind, power in (("depth", 1), ("disparity", -1)):
        for refused in (False, True):
            (scene / kind / "1x").mkdir(parents=True)
            for index, name in enumerate(dataset.train.names):
                pixels, distances = project_points(dataset.points, *(x[index] for x in dataset.train.cameras[:2]))
                _, nearest = cKDTree(pixels).query(pixel_indices(HEIGHT, WIDTH))
                np.save(scene / kind / "1x" / f"{name}.npy", distances[nearest] ** (-power if refused else power))
            if refused:
                with pytest.raises(UserError, match=r"its depth falls where its points are farther away; expected"):
                    data.load_dataset(scene)
            else:
                assert data.load_dataset(scene).train.depths.all()
            shutil.rmtree(scene / kind)


def test_depth_is_stored_like_frames_and_counts_towards_frame_memory(scene):
    write_depth(scene, train_names(scene))
    gib = 8 * HEIGHT * WIDTH * (6 + 4) / 2**30
    memory, file = (data.load_dataset(scene, frame_memory=factor * gib).train for factor in (1.01, 0.99))
    assert not isinstance(memory.depths, MappedArray)
    assert isinstance(file.depths, MappedArray)
    np.testing.assert_array_equal(memory.depths, file.depths)


@pytest.mark.parametrize("layout", sorted(data.LAYOUTS))
def test_every_layout_keeps_depth(scene, tmp_path, layout):
    dataset = data.load_dataset(write_depth(scene, train_names(scene)))
    data.LAYOUTS[layout].write(dataset, tmp_path / "copy")
    copy = data.load_dataset(tmp_path / "copy")
    assert copy.train.names == dataset.train.names
    assert copy.test.depths is None
    np.testing.assert_allclose(copy.train.depths, dataset.train.depths, rtol=1e-6)


def test_depth_stays_with_frames_made_brighter_or_darker(scene):
    dataset = data.load_dataset(write_depth(scene, train_names(scene)))
    bright = enhanced(dataset, "gamma")
    dark, _ = darken(bright, DarkeningConfig(method="analytic", exposure=0.05))
    for other in (bright, dark):
        assert not np.array_equal(other.train.images, dataset.train.images)
        np.testing.assert_array_equal(other.train.depths, dataset.train.depths)


def test_depth_stays_with_its_frame_whichever_are_held_out(scene):
    names = train_names(scene)
    dataset = data.load_dataset(write_depth(scene, names), held_out="2")
    for split in (dataset.train, dataset.test):
        assert [depth.any() for depth in split.depths] == [name in names for name in split.names]


def test_coloured_pictures_are_no_depth(scene):
    for name in train_names(scene):
        write_image(scene / "disparity" / "1x" / f"{name}.png", np.random.default_rng(0).random((HEIGHT, WIDTH, 3)))
    with pytest.raises(UserError, match=r"is a coloured picture of depth; expected grey values"):
        data.load_dataset(scene)
