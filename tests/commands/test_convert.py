"""Every layout: a scene written in it is read back the same, and all layouts agree on cameras."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scenes import edit_json, write_nerfies
from scipy.spatial.transform import Rotation

from l2dgs_jax import convert, data
from l2dgs_jax.data import colmap_model
from l2dgs_jax.data.colmap_model import ModelCamera
from l2dgs_jax.data.dataset import Dataset, Split
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime import command_line
from l2dgs_jax.types import Camera

PROPERTY = settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
WIDTH, HEIGHT = 14, 10
NAMES = st.text("ab7é_ 日.-", min_size=1, max_size=8).filter(lambda name: name.strip(" .") == name)


def to_bytes(values):
    return np.rint(np.asarray(values, float) * 255)


def assert_same(a, b):
    """Equal except for the rounding of pictures to 8 bits."""
    assert (a.width, a.height) == (b.width, b.height)
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(a.colors, b.colors)
    for left, right in ((a.train, b.train), (a.test, b.test)):
        assert left.names == right.names
        np.testing.assert_allclose(left.cameras.viewmat, right.cameras.viewmat, rtol=0, atol=1e-6)
        np.testing.assert_allclose(left.cameras.K, right.cameras.K, rtol=1e-6)
        np.testing.assert_array_equal(left.cameras.time, right.cameras.time)
        np.testing.assert_array_equal(to_bytes(left.images), to_bytes(right.images))
        for kind in ("welllit", "masks", "valid", "covisible"):
            one, other = getattr(left, kind), getattr(right, kind)
            assert (one is None) == (other is None), kind
            if one is not None:
                np.testing.assert_array_equal(to_bytes(one), to_bytes(other))


TIME = st.floats(0, 1, width=32, allow_subnormal=False)
SCENES = {
    "seed": st.integers(0, 2**32),
    "frames": st.lists(st.tuples(NAMES, TIME), min_size=4, max_size=6, unique_by=lambda frame: frame[0]),
}


def make_dataset(seed, frames, centred=False):
    """A scene of a few frames with any poses, intrinsics, instants and names."""
    rng = np.random.default_rng(seed)
    names, times = zip(*frames, strict=True)
    focal = rng.uniform(5, 50, (len(names), 1 if centred else 2)) * np.ones((1, 2))
    centre = [WIDTH / 2, HEIGHT / 2] if centred else rng.uniform(0, 10, (len(names), 2))
    K = np.tile(np.eye(3), (len(names), 1, 1))
    K[:, 0, 0], K[:, 1, 1], K[:, :2, 2] = focal[:, 0], focal[:, 1], centre
    viewmat = np.tile(np.eye(4), (len(names), 1, 1))
    viewmat[:, :3, :3] = Rotation.random(len(names), rng=rng).as_matrix()
    viewmat[:, :3, 3] = rng.uniform(-8, 8, (len(names), 3))
    images = rng.integers(0, 256, (len(names), HEIGHT, WIDTH, 3)) / 255

    def split(part):
        cameras = Camera(*(np.asarray(x[part], np.float32) for x in (viewmat, K, times)))
        return Split(tuple(names[part]), cameras, images[part].astype(np.float16))

    points = rng.normal(size=(5, 3)).astype(np.float32)
    colors = (rng.integers(1, 256, (5, 3)) / 255).astype(np.float32)
    return Dataset("x", WIDTH, HEIGHT, split(slice(0, -1)), split(slice(-1, None)), points, colors)


@pytest.mark.parametrize("layout", data.LAYOUTS)
def test_any_scene_is_read_back_from_any_layout(tmp_path_factory, layout):
    @PROPERTY
    @given(**SCENES)
    def check(seed, frames):
        dataset = make_dataset(seed, frames, centred=layout == "llff")
        folder = tmp_path_factory.mktemp(layout) / "scene"
        data.LAYOUTS[layout].write(dataset, folder)
        assert_same(data.load_dataset(folder), dataset)

    check()


def part(split, chosen):
    """The chosen frames of a split, with random covisibility masks."""
    pick = lambda x: None if x is None else x[chosen]
    return dataclasses.replace(
        split,
        names=tuple(split.names[i] for i in chosen),
        cameras=Camera(*(x[chosen] for x in split.cameras)),
        images=split.images[chosen],
        welllit=pick(split.welllit),
        masks=pick(split.masks),
        covisible=np.random.default_rng(1).random(split.images[chosen].shape[:3]) < 0.8,
    )


@pytest.mark.parametrize("layout", data.LAYOUTS)
def test_instants_truth_and_masks_of_part_of_a_scene_are_read_back(tmp_path, layout):
    dataset = data.load_dataset(write_nerfies(tmp_path / "scene", truth=True))
    subset = dataclasses.replace(dataset, train=part(dataset.train, [1, 2, 4]), test=part(dataset.test, [1]))
    assert subset.train.cameras.time.min() > 0
    data.LAYOUTS[layout].write(subset, tmp_path / "copy")
    assert_same(data.load_dataset(tmp_path / "copy"), subset)
    data.LAYOUTS[layout].write(data.load_dataset(tmp_path / "copy"), tmp_path / "again")
    assert_same(data.load_dataset(tmp_path / "again"), subset)


@pytest.mark.parametrize("layout", data.LAYOUTS)
def test_frames_that_are_also_held_out_are_read_back(tmp_path, layout):
    dataset = data.load_dataset(write_nerfies(tmp_path / "scene"))
    shared = dataclasses.replace(dataset, test=dataset.train)
    data.LAYOUTS[layout].write(shared, tmp_path / "copy")
    assert_same(data.load_dataset(tmp_path / "copy"), shared)


@pytest.mark.parametrize("layout", ["nerfies", "colmap", "llff"])
def test_invalid_pixels_are_read_back(tmp_path, layout):
    dataset = data.load_dataset(write_nerfies(tmp_path / "scene"))
    valid = np.random.default_rng(0).random(dataset.train.images.shape[:3]) < 0.8
    with_invalid = dataclasses.replace(dataset, train=dataclasses.replace(dataset.train, valid=valid))
    data.LAYOUTS[layout].write(with_invalid, tmp_path / "copy")
    assert_same(data.load_dataset(tmp_path / "copy"), with_invalid)
    with pytest.raises(UserError, match="--to transforms: some pixels of the scene are not valid; expected"):
        data.LAYOUTS["transforms"].write(with_invalid, tmp_path / "other")


def set_lens(layout, folder, k, p, size):
    """Give every camera of a written scene the lens (k1, k2, k3), (p1, p2)."""
    width, height = size
    if layout == "nerfies":
        for path in (folder / "camera").iterdir():
            edit_json(path, radial_distortion=list(k), tangential_distortion=list(p))
    elif layout == "transforms":
        edit_json(folder / "transforms.json", **dict(zip(("k1", "k2", "k3", "p1", "p2"), (*k, *p), strict=True)))
    else:
        model_folder = folder / "sparse" / "0"
        cameras = list(colmap_model.read_cameras(model_folder).values())
        lens = [
            ModelCamera("FULL_OPENCV", width, height, (*c.params, *k[:2], *p, k[2], 0.0, 0.0, 0.0)) for c in cameras
        ]
        images, cloud = colmap_model.read_images(model_folder), colmap_model.read_points(model_folder)
        for path in model_folder.iterdir():
            path.unlink()
        model_folder.rmdir()
        colmap_model.write_model(model_folder, lens, images, *cloud)


def blank(dataset):
    black = lambda split: dataclasses.replace(split, images=np.zeros_like(split.images))
    return dataclasses.replace(dataset, train=black(dataset.train), test=black(dataset.test))


def test_all_layouts_undo_the_same_lens_alike(tmp_path_factory):
    terms = st.floats(-0.125, 0.125, allow_subnormal=False)

    @settings(PROPERTY, max_examples=8)
    @given(k=st.tuples(terms, terms, terms), p=st.tuples(terms, terms), **SCENES)
    def check(seed, frames, k, p):
        dataset = make_dataset(seed, frames)
        loaded = []
        for layout in ("nerfies", "colmap", "transforms"):
            folder = tmp_path_factory.mktemp(layout) / "scene"
            data.LAYOUTS[layout].write(dataset, folder)
            set_lens(layout, folder, k, p, (WIDTH, HEIGHT))
            loaded.append(data.load_dataset(folder))
        if any((*k, *p)):
            assert np.any(loaded[0].train.images != dataset.train.images)
        for other in loaded[1:]:
            for a, b in ((loaded[0].train, other.train), (loaded[0].test, other.test)):
                np.testing.assert_allclose(a.images.astype(float), b.images.astype(float), atol=2e-3)
            assert_same(blank(loaded[0]), blank(other))

    check()


@pytest.mark.parametrize("layout", data.LAYOUTS)
def test_no_files_are_overwritten_and_no_partial_copy_is_left(tmp_path, monkeypatch, layout):
    def fill_the_disk(*_):
        raise OSError(28, "No space left on device")

    dataset = data.load_dataset(write_nerfies(tmp_path / "scene"))
    with pytest.raises(UserError, match="scene: exists already; expected a new or an empty folder"):
        data.LAYOUTS[layout].write(dataset, tmp_path / "scene")
    monkeypatch.setattr(data.LAYOUTS[layout], "write_pictures", fill_the_disk)
    with pytest.raises(UserError, match=r"copy: cannot be written \(No space left on device\)"):
        data.LAYOUTS[layout].write(dataset, tmp_path / "copy")
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_a_camera_that_llff_cannot_describe_is_refused(tmp_path):
    dataset = data.load_dataset(write_nerfies(tmp_path / "scene", principal_point=[15.0, 12.0]))
    with pytest.raises(UserError, match="--to llff: the camera of '000000' is off centre"):
        data.LAYOUTS["llff"].write(dataset, tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


def test_the_command_converts_and_reports(tmp_path, capsys):
    scene = write_nerfies(tmp_path / "a scene é", truth=True)
    arguments = [str(scene), str(tmp_path / "out"), "--to", "colmap", "--downscale", "2", "--held-out", "4"]
    convert.main(arguments)
    assert "wrote 8 frames of 16x12 and 60 points" in capsys.readouterr().out
    dataset = data.load_dataset(tmp_path / "out")
    assert dataset.test.names == ("000000", "000004")
    assert_same(dataset, data.load_dataset(scene, 2, held_out="4", normalise=False))
    assert json.loads((tmp_path / "out" / "dataset.json").read_text())["val_ids"] == ["000000", "000004"]


def test_a_mistake_on_the_command_line_is_reported_in_one_sentence(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command_line, "use_compilation_cache", lambda: None)
    for arguments, message in (
        ([str(tmp_path / "none"), str(tmp_path / "out"), "--to", "llff"], "none: no such folder"),
        (["demo", str(tmp_path / ("x" * 300)), "--to", "llff"], "File name too long"),
        (["demo", str(tmp_path), "--to", "llff", "--downscale", "0"], "--downscale 0: expected"),
        (["demo", str(tmp_path), "--to", "llff", "--format", "colmap"], "sparse/0: no such model"),
    ):
        with pytest.raises(SystemExit) as caught:
            command_line.run(convert.main, arguments)
        assert caught.value.code == 2
        text = capsys.readouterr().err
        assert message in text
        assert text.count("\n") == 1
    assert not list(tmp_path.iterdir())
