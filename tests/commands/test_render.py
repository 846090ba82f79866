"""The command that writes the views of a run as images."""

import json

import cv2
import finished_run
import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest

from l2dgs_jax.cameras import resize, select_camera
from l2dgs_jax.cameras.paths import interpolate
from l2dgs_jax.data import images
from l2dgs_jax.data.color import linear_to_srgb
from l2dgs_jax.model.rendering import expected_depth
from l2dgs_jax.render import main
from l2dgs_jax.runs import pictures
from l2dgs_jax.runtime import command_line
from l2dgs_jax.visualize.video import video_path


@pytest.fixture(autouse=True)
def _no_compilation_cache(monkeypatch):
    monkeypatch.setenv("L2DGS_JAX_CACHE", "off")


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.getbasetemp()


def test_images_are_the_output_of_the_renderer(base, tmp_path, capsys):
    run = finished_run.opened(base)
    command_line.run(main, [str(run.folder), "--output", str(tmp_path / "out")])
    folder = tmp_path / "out" / "test"
    assert f"wrote 2 views to {folder}" in capsys.readouterr().out
    unit = json.loads((folder / "depth.json").read_text())["unit"]
    written = {str(path.relative_to(folder)) for path in folder.rglob("*.*")}
    kinds = ("welllit", "lowlight", "illumination", "reflectance", "depth")
    names = run.dataset.test.names
    assert written == {f"{kind}/{name}.png" for kind in kinds for name in names} | {"depth.json", "render.json"}

    highest = 0
    for i, name in enumerate(names):
        output = run.renderer()(select_camera(run.dataset.test.cameras, i))
        for kind in kinds[:-1]:
            image = cv2.imread(str(folder / kind / f"{name}.png"), cv2.IMREAD_UNCHANGED)
            assert image.ndim == (2 if kind == "illumination" else 3)
            expected = np.asarray(getattr(output.images, kind), np.float32)
            colours = image if image.ndim == 2 else image[..., ::-1]
            np.testing.assert_array_equal(colours, np.rint(255 * np.clip(expected, 0, 1)))
        depth = cv2.imread(str(folder / "depth" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16
        highest = max(highest, depth.max())
        np.testing.assert_allclose(depth * unit, expected_depth(output), atol=unit)
        assert 1.5 < np.median(depth * unit) < 6.5  # cameras are 4 from the centre of points within 1.8
    assert highest == 65535


def test_splits_and_stages_have_separate_folders(base, capsys):
    run_folder = finished_run.folder(base)
    command_line.run(main, [str(run_folder), "--split", "train", "--stage", "coarse"])
    assert (run_folder / "renders_coarse" / "train" / "welllit" / "000000.png").is_file()
    assert not (run_folder / "renders").exists()


def files(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_interrupted_rendering_is_completed_to_the_same_files(base, tmp_path, monkeypatch, capsys):
    arguments = [str(finished_run.folder(base)), "--split", "train", "--outputs", "welllit", "depth", "b2", "--output"]
    command_line.run(main, [*arguments, str(tmp_path / "whole")])
    written = []

    def interrupt_after_seven(path, image):
        if len(written) == 7:
            raise KeyboardInterrupt
        written.append(path)
        images.write_image(path, image)

    with monkeypatch.context() as patch:
        patch.setattr(pictures, "write_image", interrupt_after_seven)
        with pytest.raises(SystemExit):
            command_line.run(main, [*arguments, str(tmp_path / "parts")])
    kept = {path: path.stat().st_mtime_ns for path in written[:6]}  # the seventh belongs to an incomplete view
    capsys.readouterr()
    command_line.run(main, [*arguments, str(tmp_path / "parts")])
    assert "wrote 5 views to" in capsys.readouterr().out
    assert files(tmp_path / "parts") == files(tmp_path / "whole")
    assert {path: path.stat().st_mtime_ns for path in kept} == kept

    exponents = cv2.imread(str(tmp_path / "whole" / "train" / "b2" / "000000.png"), cv2.IMREAD_UNCHANGED)
    run = finished_run.opened(base)
    expected = np.asarray(run.render(run.dataset.train.camera(0)).images.attenuation[..., 1])
    np.testing.assert_allclose(exponents * (10 / 65535), expected, atol=1e-4)


def test_frames_of_different_options_are_not_mixed(base, tmp_path, capsys):
    arguments = [str(finished_run.folder(base)), "--path", "spiral", "--output", str(tmp_path), "--outputs", "welllit"]
    command_line.run(main, [*arguments, "--frames", "2"])
    before = files(tmp_path)
    for more, what in ((["--frames", "3"], "cameras"), (["--frames", "2", "--format", "exr"], "format")):
        with pytest.raises(SystemExit):
            command_line.run(main, [*arguments, *more])
        message = f"spiral: holds frames of another {what}; expected the same: remove the folder, or name another"
        assert message in capsys.readouterr().err
        assert files(tmp_path) == before
    command_line.run(main, [*arguments, "alpha", "--frames", "2"])  # other outputs have folders of their own
    assert "wrote 2 views" in capsys.readouterr().out
    (tmp_path / "spiral" / "render.json").unlink()
    with pytest.raises(SystemExit):
        command_line.run(main, [*arguments, "--frames", "2"])
    assert "holds frames without a render.json" in capsys.readouterr().err


def test_exr_holds_linear_light_and_plain_numbers(base, tmp_path):
    run = finished_run.opened(base)
    options = ["--format", "exr", "--outputs", "welllit", "reflectance", "depth", "b1", "alpha"]
    command_line.run(main, [str(run.folder), "--output", str(tmp_path), *options])
    name = run.dataset.test.names[0]
    read = lambda kind: oiio.ImageBuf(str(tmp_path / "test" / kind / f"{name}.exr")).get_pixels(oiio.FLOAT)
    view = run.render(run.dataset.test.camera(0))
    np.testing.assert_allclose(linear_to_srgb(read("welllit")), view.images.welllit, atol=1e-5)
    np.testing.assert_allclose(read("reflectance"), view.images.reflectance, atol=1e-5)
    np.testing.assert_allclose(read("depth")[..., 0], expected_depth(view), rtol=1e-5)
    np.testing.assert_allclose(read("b1")[..., 0], view.images.attenuation[..., 0], rtol=1e-5)
    np.testing.assert_allclose(read("alpha")[..., 0], view.alpha, atol=1e-5)
    assert not list(tmp_path.rglob("depth.json"))


@pytest.mark.slow
def test_size_enlarges_the_picture_and_crops_it_to_another_shape(base, tmp_path):
    run = finished_run.opened(base)
    arguments = [str(run.folder), "--outputs", "welllit"]
    read = lambda size: cv2.imread(str(tmp_path / size / "test" / "welllit" / f"{name}.png"))[..., ::-1]
    name = run.dataset.test.names[0]
    for size in ("72", "72x18"):
        command_line.run(main, [*arguments, "--size", size, "--output", str(tmp_path / size)])
    view = run.render(resize(run.dataset.test.camera(0), 3), 72, 54)
    np.testing.assert_allclose(read("72"), 255 * np.clip(view.images.welllit, 0, 1), atol=0.51)
    np.testing.assert_allclose(read("72x18"), read("72")[18:36], atol=1)


def test_pictures_side_by_side_are_written_as_images_or_video(base, tmp_path, capsys):
    run = finished_run.opened(base)
    options = ["--path", "freeze-camera", "--frames", "3", "--outputs", "lowlight", "welllit", "depth"]
    arguments = [str(run.folder), *options, "--output", str(tmp_path), "--side-by-side"]
    command_line.run(main, arguments)
    folder, name = tmp_path / "freeze-camera", "lowlight-welllit-depth"
    written = [cv2.imread(str(folder / name / f"{i:06d}.png"))[..., ::-1] for i in range(3)]
    camera = select_camera(interpolate(run.dataset.train.cameras, np.full(3, 0.5)), 0)
    for picture, time in zip(written, (0, 0.5, 1), strict=True):
        view = run.render(camera._replace(time=np.float32(time)))
        shown = np.hstack([view.images.lowlight, view.images.welllit])
        assert picture.shape == (shown.shape[0], 72, 3)
        np.testing.assert_allclose(picture[:, :48], 255 * np.clip(shown, 0, 1), atol=0.51)
        assert np.ptp(picture[:, 48:], axis=(0, 1)).max() > 50

    command_line.run(main, [*arguments, "--format", "video", "--fps", "5"])
    path = video_path(folder / name)
    assert f"wrote {path}" in capsys.readouterr().out
    film = cv2.VideoCapture(str(path))
    assert film.get(cv2.CAP_PROP_FPS) == 5
    for picture in written:
        frame = film.read()[1][..., ::-1]
        assert np.abs(frame.astype(float) - picture).mean() < 12
    assert not film.grab()


def camera_path(**changes):
    pose = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1]
    return json.dumps({"camera_path": [{"camera_to_world": pose, "fov": 40} | changes], "fps": 30})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{missing}"], "missing: not a training run; expected a folder with config.json"),
        (["{file}"], "file: not a training run; expected a folder with config.json"),
        (["{run}", "--output", "{file}"], "expected a writable folder"),
        (["{run}", "--path", "spirale"], "--path spirale: no such file; expected one, or dataset, interpolate, spiral"),
        (["{run}", "--path", ""], "--path : no such file; expected one, or dataset"),
        (["{run}", "--path", "{file}"], "file: cannot be read as JSON"),
        (["{run}", "--path", "{late}"], "late.json, camera 1 of 1: 'time' is 1.5; expected an instant from 0 to 1"),
        (["{run}", "--path", "{good}", "--times", "0", "1"], "has its own frames; expected no --frames and no --times"),
        (["{run}", "--frames", "4"], "--path dataset: has its own frames"),
        (["{run}", "--path", "orbit", "--frames", "0"], "--frames 0: expected at least 1"),
        (["{run}", "--path", "orbit", "--times", "0", "1.5"], "1.5 is no instant; expected 0, the first, to 1"),
        (["{run}", "--path", "orbit", "--times", "nan", "1"], "nan is no instant"),
        (["{run}", "--path", "freeze-time", "--at", "-0.5"], "-0.5 is no instant"),
        (["{run}", "--path", "orbit", "--at", "0.5"], "--at 0.5: nothing stands still; expected --path freeze-time"),
        (["{run}", "--size", "0"], "--size 0: 0x1 pixels; expected at least 1, and no picture over 16382"),
        (["{run}", "--size", "99999x10"], "--size 99999x10: 99999x10 pixels; expected"),
        (["{run}", "--size", "-5"], "--size -5: expected WIDTH or WIDTHxHEIGHT"),
        (["{run}", "--size", "wide"], "--size wide: expected WIDTH or WIDTHxHEIGHT"),
        (["{run}", "--fps", "0"], "0 frames a second; expected --fps from 0.1"),
        (["{run}", "--outputs"], "expected at least one, and none of them twice"),
        (["{run}", "--outputs", "depth", "depth"], "expected at least one, and none of them twice"),
        (["{run}", "--outputs", "depth", "--side-by-side"], "--side-by-side: expected at least two --outputs"),
        (["{run}", "--format", "exr", "--side-by-side"], "and --format png or video"),
    ],
)
def test_invalid_input_gives_one_sentence_and_exit_2(base, tmp_path, capsys, arguments, message):
    paths = {name: tmp_path / name for name in ("missing", "file", "late.json", "good.json")}
    paths["file"].write_text("")
    paths["late.json"].write_text(camera_path(time=1.5))
    paths["good.json"].write_text(camera_path())
    paths = {name.removesuffix(".json"): path for name, path in paths.items()} | {"run": finished_run.folder(base)}
    with pytest.raises(SystemExit) as caught:
        command_line.run(main, [argument.format(**paths) for argument in arguments])
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1


def test_an_unknown_output_is_refused_with_a_list_of_outputs(base, capsys):
    with pytest.raises(SystemExit) as caught:
        command_line.run(main, [str(finished_run.folder(base)), "--outputs", "colour"])
    assert caught.value.code == 2
    assert "welllit" in capsys.readouterr().err
