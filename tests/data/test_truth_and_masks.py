"""Ground truth, masks, and valid pixels."""

import shutil

import numpy as np
import pytest
from scenes import GAIN, write_image, write_nerfies

from l2dgs_jax import data


def test_truth_and_masks_are_read(tmp_path):
    dataset = data.load_dataset(write_nerfies(tmp_path, truth=True), 2)
    for split in (dataset.train, dataset.test):
        assert split.masks.dtype == bool
        assert split.masks.shape == split.images.shape[:3]
        assert 0 < split.masks.mean() < 0.5
        np.testing.assert_allclose(split.welllit, GAIN * split.images.astype(float), atol=GAIN / 255)


def test_a_downscaled_mask_is_set_where_most_of_its_pixels_are(tmp_path):
    scene = write_nerfies(tmp_path, truth=True)
    mask = np.zeros((24, 32))
    mask[:2, :2], mask[0, 2:4] = [[1, 1], [1, 0]], 1  # three of four, two of four
    for path in (scene / "mask" / "1x").iterdir():
        write_image(path, mask)
    masks = data.load_dataset(scene, 2).train.masks
    assert masks[:, 0, 0].all()
    assert masks.sum() == len(masks)


def test_truth_of_one_split_only_is_kept(tmp_path):
    scene = write_nerfies(tmp_path, truth=True)
    for name in data.load_dataset(scene).train.names:
        (scene / "well" / "1x" / f"{name}.png").unlink()
    shutil.rmtree(scene / "mask")
    dataset = data.load_dataset(scene)
    assert dataset.train.welllit is None
    assert dataset.test.welllit is not None
    assert dataset.test.masks is None


def test_pixels_with_alpha_0_are_invalid(tmp_path):
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
def test_pixels_that_undistortion_cannot_fill_are_invalid(tmp_path, downscale):
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


def test_covisible_masks_are_read(tmp_path):
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


@pytest.mark.parametrize("kind", ["well", "mask"])
def test_pictures_that_are_called_otherwise_than_the_frames_are_mentioned(tmp_path, kind):
    scene = write_nerfies(tmp_path, truth=True)
    for path in sorted((scene / kind / "1x").iterdir()):
        path.rename(path.with_name(f"{kind}_{path.name}"))
    dataset = data.load_dataset(scene)
    assert (dataset.train.welllit if kind == "well" else dataset.train.masks) is None
    example = f"{kind}/1x/000000.png"
    assert dataset.notes == (f"{kind}/ has no picture that is called like a frame, such as {example}: not used",)
