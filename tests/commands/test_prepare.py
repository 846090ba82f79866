import json
import os
import shutil
import sys

import clips
import numpy as np
import pytest
from scenes import write_image

from l2dgs_jax import data, prepare
from l2dgs_jax.data import demo, images
from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.capture import CaptureConfig, frames, pipeline, structure

pycolmap = pytest.importorskip("pycolmap")
COUNT = 10


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A folder of dark frames in which a square moves, and their cameras."""
    folder = tmp_path_factory.mktemp("source")
    pictures, views, _ = clips.clip(COUNT, light=0.2)
    for i, picture in enumerate(pictures):
        write_image(folder / f"Küche nachts {i + 5}.png", images.to_bytes(picture))
    return folder, views


def run(*arguments):
    prepare.main([*map(str, arguments), "--threads", "1"])


def pose_errors(model, truth):
    """Median distance of camera centres over the trajectory's length, and median angle, after similarity alignment.

    `truth` maps names to world-to-camera matrices.
    """
    views = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda view: view.name)
    given = np.stack([truth[view.name] for view in views])
    centres = -np.einsum("fji,fj->fi", given[:, :3, :3], given[:, :3, 3])
    found = np.stack([view.projection_center() for view in views])
    similarity = pycolmap.estimate_sim3d(found, centres)
    distances = np.linalg.norm(similarity * found - centres, axis=-1)
    turn = similarity.rotation.matrix()
    rotations = np.stack([view.cam_from_world().rotation.matrix() @ turn.T for view in views])
    cosines = (np.einsum("fij,fij->f", rotations, given[:, :3, :3]) - 1) / 2
    length = np.linalg.norm(np.diff(centres, axis=0), axis=-1).sum()
    return np.median(distances) / length, np.degrees(np.median(np.arccos(np.clip(cosines, -1, 1))))


def test_dark_frames_get_poses_even_after_an_interruption(source, tmp_path, monkeypatch, capsys):
    folder, views = source
    output = tmp_path / "a scene – ü"

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(structure, "reconstruct", interrupt)
        with pytest.raises(SystemExit) as caught:
            run(folder, output)
    assert caught.value.code == 130
    assert not output.exists()
    assert [path.name for path in tmp_path.iterdir()] == [f"{output.name}.partial"]

    with monkeypatch.context() as patch:
        patch.setattr(frames, "scan", interrupt)  # done already: not called again
        run(folder, output)
    assert list(tmp_path.iterdir()) == [output]
    assert f"registered    {COUNT} of {COUNT} frames" in capsys.readouterr().out
    found = json.loads((output / "report.json").read_text())
    assert found["registered"] == found["sampled"] == COUNT
    assert found["reprojection_error_px"] < 0.5
    assert found["camera"]["focal_length_px"] == pytest.approx(clips.FOCAL, rel=0.03)
    assert found["baseline_to_depth"] == pytest.approx(3.2 / 5, rel=0.2)
    assert images.read_header(output / "contact_sheet.png").size[0] > 6 * clips.WIDTH

    model = pycolmap.Reconstruction(output / "sparse" / "0")
    names = [f"{i + 5:06d}.png" for i in range(COUNT)]
    assert sorted(path.name for path in (output / "images").iterdir()) == names
    distance, angle = pose_errors(model, dict(zip(names, views, strict=True)))
    assert distance < 0.005
    assert angle < 0.5
    dataset = data.load_dataset(output)
    assert len(dataset.train.names) + len(dataset.test.names) == COUNT
    times = dict(zip(dataset.train.names, dataset.train.cameras.time, strict=True))
    assert all(time == pytest.approx((int(name) - 5) / (COUNT - 1)) for name, time in times.items())
    colors = np.array([point.color for point in model.points3D.values()])
    assert colors.mean() < 0.3 * 255  # of the dark frames, not of the bright copies
    for name in names:
        original = folder / found["origins"][name]
        assert (output / "images" / name).read_bytes() == original.read_bytes()


def test_frames_that_do_not_belong_together_are_named(tmp_path):
    for i in range(6):
        noise = np.random.default_rng(i).random((60, 80, 3), np.float32)
        write_image(tmp_path / "source" / f"{i}.png", images.to_bytes(noise))
    with pytest.raises(UserError) as caught:
        run(tmp_path / "source", tmp_path / "out")
    text = str(caught.value)
    assert "0 of 6 frames found a pose" in text
    assert "000000.png (" in text
    assert "film more slowly" in text
    assert "\n" not in text
    assert (tmp_path / "out.partial" / "contact_sheet.png").exists()
    assert not (tmp_path / "out").exists()


def still_video(folder):
    clips.write_video(folder / "tripod.avi", [images.to_bytes(x) for x in clips.clip(6, reach=0.0, light=0.3)[0]])
    return folder / "tripod.avi"


def panning_video(folder):
    pictures = []
    for angle in np.linspace(-0.2, 0.2, 8):
        turn = np.eye(4)
        turn[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        pictures.append(images.to_bytes(0.3 * clips.render(turn @ clips.camera(0.0))[0]))
    clips.write_video(folder / "pan.avi", pictures)
    return folder / "pan.avi"


def one_frame(folder):
    clips.write_video(folder / "photo.avi", [np.zeros((48, 64, 3), np.uint8)])
    return folder / "photo.avi"


def other_file(name, content=b""):
    def make(folder):
        (folder / name).write_bytes(content)
        return folder / name

    return make


def pictures(folder):
    for i in range(6):
        write_image(folder / "in" / f"a {i}.png", np.random.default_rng(i).random((24, 32, 3)))
    return folder / "in"


def damaged_picture(folder):
    path = pictures(folder) / "a 3.png"
    path.write_bytes(path.read_bytes()[:-300])
    return folder / "in"


def mixed_sizes(folder):
    write_image(pictures(folder) / "a 4.png", np.zeros((24, 30, 3)))
    return folder / "in"


def existing_output(folder):
    (folder / "out").mkdir()
    (folder / "out" / "mine").write_text("work")
    return pictures(folder)


def partial_output_of_others(folder):
    (folder / "out.partial").mkdir()
    (folder / "out.partial" / "mine").write_text("work")
    return pictures(folder)


FAULTS = {
    "one frame": ("photo.avi: holds 1 frame(s)", one_frame),
    "tripod": ("tripod.avi: the camera stands still", still_video),
    "turning on the spot": ("pan.avi: 0 of", panning_video),
    "no video": ("notes.txt: not a video that OpenCV can read", other_file("notes.txt", b"dark")),
    "empty video": ("clip.mp4: not a video that OpenCV can read", other_file("clip.mp4")),
    "zip": ("frames.zip: not a video that OpenCV can read", other_file("frames.zip", b"PK\x03\x04" + bytes(100))),
    "nothing": ("gone.mp4: no such file or folder", lambda folder: folder / "gone.mp4"),
    "empty folder": ("in: holds no pictures", lambda folder: (folder / "in").mkdir() or folder / "in"),
    "damaged picture": ("a 3.png: expected a readable picture", damaged_picture),
    "mixed sizes": ("a 4.png: the picture is 30x24 pixels; expected 32x24 as a 0.png", mixed_sizes),
    "output exists": ("out: exists already", existing_output),
    "work of others": ("out.partial: exists, but prepare has not written it", partial_output_of_others),
}


WITH_WORK = ("tripod", "turning on the spot", "work of others")  # with work to go on from, or not prepare's


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named_in_one_sentence_and_nothing_is_written(tmp_path, fault):
    message, make = FAULTS[fault]
    given = make(tmp_path)
    before = {path for path in tmp_path.rglob("*") if "out" in path.relative_to(tmp_path).parts[0]}
    with pytest.raises(UserError) as caught:
        run(given, tmp_path / "out")
    text = str(caught.value)
    assert message in text
    assert "expected" in text
    assert "\n" not in text
    assert all(path.exists() for path in before)
    assert (tmp_path / "out").exists() == (fault == "output exists")
    assert (tmp_path / "out.partial").exists() == (fault in WITH_WORK)


def test_an_output_that_cannot_be_written_is_named(tmp_path):
    source = pictures(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"out.partial: Not a directory; expected .* a writable output"):
        run(source, tmp_path / "file" / "out")


@pytest.mark.parametrize("option", [("--frames", "2"), ("--threads", "-1")])
def test_options_out_of_range_are_refused(tmp_path, option):
    with pytest.raises(UserError, match=f"{' '.join(option)}: expected"):
        prepare.main([str(tmp_path), str(tmp_path / "out"), *option])


def test_a_missing_package_is_reported_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(UserError, match=r'pip install "l2dgs-jax\[sfm\]"'):
        run(pictures(tmp_path), tmp_path / "out")
    assert not (tmp_path / "out.partial").exists()


def test_changed_settings_or_pictures_start_over(tmp_path):
    source = pictures(tmp_path)
    open_work = lambda **settings: pipeline._open_work(source, tmp_path / "out", CaptureConfig(**settings))
    work = open_work()
    (work / "candidates.json").write_text("[]")
    assert (open_work() / "candidates.json").exists()
    assert not (open_work(frames=7) / "candidates.json").exists()
    (work / "candidates.json").write_text("[]")
    os.utime(source / "a 3.png", (2e9, 2e9))  # repaired in place
    assert not (open_work(frames=7) / "candidates.json").exists()


def test_an_output_among_the_pictures_starts_nothing_over(tmp_path, capsys):
    source = pictures(tmp_path)
    for _ in range(3):
        pipeline._open_work(source, source / "out", CaptureConfig())
    assert capsys.readouterr().out.count("going on in") == 2


@pytest.mark.slow
@pytest.mark.parametrize("k1", [-0.1, -0.3])
def test_lens_distortion_is_found(tmp_path, k1):
    for i, picture in enumerate(clips.clip(COUNT, light=0.3)[0]):
        write_image(tmp_path / "source" / f"{i}.png", images.to_bytes(clips.through_lens(picture, k1)))
    run(tmp_path / "source", tmp_path / "out")
    found = json.loads((tmp_path / "out" / "report.json").read_text())
    assert found["registered"] == COUNT
    focal, *_, distortion = found["camera"]["params"]
    assert focal == pytest.approx(clips.FOCAL, rel=0.03)
    assert distortion == pytest.approx(k1, abs=0.03)


@pytest.mark.slow
def test_with_one_thread_results_are_reproducible(source, tmp_path):
    for name in ("first", "second"):
        run(source[0], tmp_path / name)
    first, second = ((tmp_path / name / "sparse/0/points3D.bin").read_bytes() for name in ("first", "second"))
    assert first == second


@pytest.mark.slow
def test_the_demo_clip_gets_the_poses_that_it_came_with(tmp_path):
    shutil.copytree(demo.FOLDER / "rgb" / "1x", tmp_path / "source")
    run(tmp_path / "source", tmp_path / "out")
    found = json.loads((tmp_path / "out" / "report.json").read_text())
    assert found["registered"] >= 0.9 * found["sampled"]
    truth = {}
    for name in found["origins"]:
        camera = json.loads((demo.FOLDER / "camera" / name).with_suffix(".json").read_text())
        rotation = np.array(camera["orientation"])
        truth[name] = np.block([[rotation, (-rotation @ camera["position"])[:, None]], [np.eye(4)[3:]]])
    distance, angle = pose_errors(pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0"), truth)
    assert distance < 0.02
    assert angle < 2
