"""Recognising the layout of a scene, its frames and its pictures."""

import shutil

import numpy as np
import pytest
from scenes import write_image, write_nerfies

from l2dgs_jax import data
from l2dgs_jax.errors import UserError


def test_pictures_that_differ_only_in_suffix_are_refused_unless_listed(tmp_path):
    scene = write_nerfies(tmp_path / "scene", 9)
    expected = data.load_dataset(scene)
    for kind, layout in data.LAYOUTS.items():
        layout.write(expected, tmp_path / kind)
        root = tmp_path / kind / ("rgb/1x" if kind == "nerfies" else "images")
        write_image(root / "000003.jpg", np.ones((24, 32, 3)))
        if kind in ("colmap", "transforms"):  # these layouts list their pictures
            assert data.load_dataset(tmp_path / kind).train.images.max() < 0.5
        else:
            with pytest.raises(UserError, match=r"000003\.jpg: differs from 000003\.png only in its suffix; expected"):
                data.load_dataset(tmp_path / kind)


def test_two_layouts_in_one_folder_are_refused_unless_one_is_named(tmp_path):
    scene = write_nerfies(tmp_path / "scene", 9)
    dataset = data.load_dataset(scene)
    data.LAYOUTS["transforms"].write(dataset, tmp_path / "other")
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
