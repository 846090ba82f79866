"""The command that writes motion masks into a scene."""

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from planar_video import FOCAL, HEIGHT, WIDTH, video
from scenes import write_image, write_json

from l2dgs_jax import data, masks
from l2dgs_jax.data.dataset import Dataset, Original
from l2dgs_jax.data.images import area_average
from l2dgs_jax.data.lens import Lens, undistort
from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.motion_masks import as_taken, compute_masks, preview, scene_masks, write_masks
from l2dgs_jax.runtime import command_line

FRAMES, HELD_OUT = 8, ("000003", "000006")


@pytest.fixture(autouse=True)
def _no_compilation_cache(monkeypatch):
    monkeypatch.setenv("L2DGS_JAX_CACHE", "off")


@pytest.fixture
def scene(tmp_path):
    film = video(motion=(0.0, 0.09), frames=FRAMES)
    folder = tmp_path / "a scene"
    names = [f"{i:06d}" for i in range(FRAMES)]
    for i, name in enumerate(names):
        camera = {
            "orientation": np.eye(3).tolist(),
            "position": (-film.cameras.viewmat[i, :3, 3]).tolist(),
            "focal_length": FOCAL,
            "principal_point": [WIDTH / 2, HEIGHT / 2],
            "image_size": [WIDTH, HEIGHT],
        }
        write_json(folder / "camera" / f"{name}.json", camera)
        write_image(folder / "rgb" / "1x" / f"{name}.png", film.images[i].astype(float))
    train = [name for name in names if name not in HELD_OUT]
    write_json(folder / "dataset.json", {"ids": names, "train_ids": train, "val_ids": list(HELD_OUT)})
    np.save(folder / "points.npy", film.points.astype(np.float32))
    return folder


def files(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def error_of(capsys, arguments):
    with pytest.raises(SystemExit) as caught:
        command_line.run(masks.main, [str(argument) for argument in arguments])
    assert caught.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1].startswith("error: ")
    assert not any("Traceback" in line for line in lines)
    return lines[-1]


def test_masks_of_both_splits_are_written_and_read_back(scene, tmp_path, capsys):
    before = files(scene)
    command_line.run(masks.main, [str(scene), "--preview", str(tmp_path / "preview.png")])
    folder = scene / "mask" / "1x"
    assert f"wrote {FRAMES} masks to {folder}" in capsys.readouterr().out
    assert files(scene).keys() - before.keys() == {f"mask/1x/{i:06d}.png" for i in range(FRAMES)}
    written = cv2.imread(str(folder / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert written.shape == (HEIGHT, WIDTH)
    assert set(np.unique(written)) == {0, 255}

    dataset, truth = data.load_dataset(scene), video(motion=(0.0, 0.09), frames=FRAMES).truth
    held_out = np.isin([f"{i:06d}" for i in range(FRAMES)], HELD_OUT)
    for split, expected in ((dataset.train, truth[~held_out]), (dataset.test, truth[held_out])):
        assert (split.masks & expected).sum() / (split.masks | expected).sum() > 0.65
    assert data.load_dataset(scene, 2).test.masks.any()  # masks of full size serve smaller ones

    # Only the preview's last column is tinted, where the board is.
    sheet = cv2.imread(str(tmp_path / "preview.png")).astype(int)
    redder = [(column[..., 2] > column[..., 0] + 80).mean() for column in np.array_split(sheet, 3, axis=1)]
    assert redder[2] > redder[0] + 0.02


def test_frames_in_a_file_give_the_same_masks(scene):
    memory, file = data.load_dataset(scene), data.load_dataset(scene, frame_memory=0.0)
    found = compute_masks(memory)
    np.testing.assert_array_equal(compute_masks(file), found)
    np.testing.assert_array_equal(preview(file, found), preview(memory, found))


@pytest.mark.parametrize("lens", [Lens(), Lens((-0.3, 0.1), tangential=(0.01, -0.02)), Lens((0.05,), fisheye=True)])
def test_masks_are_distorted_by_the_lens_like_the_pictures(lens):
    width, height, downscale = 161, 122, 2
    K = np.array([[100.0, 0, 83], [0, 105, 60], [0, 0, 1]])
    rows, columns = np.mgrid[: height // downscale, : width // downscale]
    mask = np.hypot(rows - 15, columns - 60) < 12
    full = as_taken(mask, downscale, Original((width, height), K, lens))
    assert full.shape == (height, width)
    straight = area_average(undistort(full[..., None].astype(np.float32), K, lens), downscale)
    read_back = straight[: height // downscale, : width // downscale, 0] > 0.5
    assert (read_back & mask).sum() / (read_back | mask).sum() > 0.95


def test_existing_masks_are_kept_without_overwrite(scene, capsys):
    for name in files(scene / "rgb" / "1x"):
        write_image(scene / "mask" / "1x" / name, np.zeros((HEIGHT, WIDTH)))
    before = files(scene)
    message = "mask: holds masks of this scene; expected none, or --overwrite to replace them"
    for downscale in (1, 2):  # half-size masks would hide the given ones at half size
        assert message in error_of(capsys, [scene, "--downscale", downscale])
        assert files(scene) == before
    shutil.copytree(scene / "mask" / "1x", scene / "mask" / "2x")
    command_line.run(masks.main, [str(scene), "--overwrite"])
    assert files(scene).keys() == before.keys()  # masks of another size are removed: readers would prefer them
    assert data.load_dataset(scene).train.masks.any()


def test_frame_names_may_have_folders_spaces_and_other_scripts(tmp_path):
    names = ["left/a b", "right/日本"]
    (tmp_path / "mask" / "1x").mkdir(parents=True)
    (tmp_path / "mask" / "1x" / "older.png").write_text("")
    write_masks(tmp_path / "mask", names, [np.eye(3, dtype=bool), np.zeros((3, 3), bool)])
    assert files(tmp_path).keys() == {f"mask/1x/{name}.png" for name in names}
    assert data.images.read_image(tmp_path / "mask" / "1x" / "left" / "a b.png")[..., 0].sum() == 3


def test_a_failure_midway_leaves_the_scene_as_it_was(scene, monkeypatch):
    write_image(scene / "mask" / "1x" / "000000.png", np.zeros((HEIGHT, WIDTH)))
    before = files(scene)
    written = []

    def fill_the_disk(path, image):
        written.append(path)
        if len(written) == 3:
            raise OSError(28, "No space left on device")
        write_image(path, image)

    monkeypatch.setattr(scene_masks, "write_image", fill_the_disk)
    with pytest.raises(UserError, match=r"mask: cannot be written \(No space left on device\)"):
        write_masks(scene / "mask", list("abcd"), [np.zeros((3, 3), bool)] * 4)
    assert files(scene) == before
    assert sorted(path.name for path in scene.iterdir()) == ["camera", "dataset.json", "mask", "points.npy", "rgb"]


def test_an_interruption_between_both_renames_leaves_the_old_masks(tmp_path, monkeypatch):
    write_image(tmp_path / "mask" / "1x" / "a.png", np.zeros((3, 3)))
    before, rename = files(tmp_path), os.rename

    def interrupted(source, target):
        if Path(source).name == "new":
            raise KeyboardInterrupt
        rename(source, target)

    monkeypatch.setattr(os, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_masks(tmp_path / "mask", ["a"], [np.ones((3, 3), bool)])
    assert files(tmp_path) == before
    assert [path.name for path in tmp_path.iterdir()] == ["mask"]


def test_invalid_input_gives_one_sentence_before_any_work(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(masks, "compute_masks", lambda dataset: pytest.fail("too late"))
    monkeypatch.chdir(tmp_path)  # where no folder is called "demo"
    assert "no such folder" in error_of(capsys, [tmp_path / "missing"])
    assert "no folder to write masks to" in error_of(capsys, ["demo"])
    assert "not a picture's suffix" in error_of(capsys, [scene, "--preview", tmp_path / "preview.txt"])
    assert "expected a file in a writable folder" in error_of(capsys, [scene, "--preview", tmp_path / "no" / "x.png"])
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert "cannot be written; expected a writable folder" in error_of(capsys, [scene])
    monkeypatch.undo()
    (scene / "mask").write_text("")
    assert "mask: is a file; expected a folder" in error_of(capsys, [scene])
    assert (scene / "mask").read_text() == ""


def test_a_scene_of_a_single_instant_is_refused_by_name(scene):
    dataset = data.load_dataset(scene)
    frozen = lambda split: split.__class__(
        split.names, split.cameras._replace(time=0 * split.cameras.time), split.images
    )
    parts = (dataset.width, dataset.height, frozen(dataset.train), frozen(dataset.test), dataset.points)
    with pytest.raises(UserError, match="quiet: all frames are of one instant"):
        compute_masks(Dataset("quiet", *parts))
