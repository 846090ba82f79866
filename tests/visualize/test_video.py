"""Videos written by the package, read by other decoders and played by a browser."""

import sys

import av
import browser
import cv2
import finished_run
import numpy as np
import pytest

from l2dgs_jax.cameras import select_camera
from l2dgs_jax.cameras.paths import space_time_path
from l2dgs_jax.errors import UserError
from l2dgs_jax.visualize.films import DEFAULT_FPS, RUN_VIDEO_SECONDS, write_run_video
from l2dgs_jax.visualize.video import open_video, video_path


def by_opencv(path):
    capture = cv2.VideoCapture(str(path))
    frames = []
    while (read := capture.read())[0]:
        frames.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB))
    return np.stack(frames).astype(float), capture.get(cv2.CAP_PROP_FPS)


def by_pyav(path):
    with av.open(str(path)) as file:
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
        return np.stack(frames).astype(float), float(file.streams.video[0].average_rate)


@pytest.fixture(params=[".mp4", ".webm"])
def decode(request, monkeypatch):
    """Videos are written with PyAV or without it; the decoder is always another program."""
    if request.param == ".webm":
        monkeypatch.setitem(sys.modules, "av", None)
    decoder = by_opencv if request.param == ".mp4" else by_pyav

    def read(path):
        assert path.suffix == request.param
        return decoder(path)

    return read


def moving_ramp(count, height, width):
    """Smooth colours, because codecs blur; all pixels differ, and all pictures."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    return [np.rint(255 * np.stack([x, y, np.full_like(x, i / count)], -1)).astype(np.uint8) for i in range(count)]


def write(stem, frames, fps=24):
    height, width = frames[0].shape[:2]
    with open_video(stem, (width, height), fps) as add:
        for frame in frames:
            add(frame)
    return video_path(stem)


@pytest.mark.parametrize(("height", "width", "fps"), [(96, 128, 24), (75, 101, 30), (64, 64, 12.5)])
def test_another_decoder_reads_every_frame_in_its_colours(tmp_path, decode, height, width, fps):
    pictures = moving_ramp(20, height, width)
    frames, rate = decode(write(tmp_path / "take.1", pictures, fps))
    assert frames.shape == (20, height + height % 2, width + width % 2, 3)
    assert rate == pytest.approx(fps, rel=1e-3)
    errors = np.abs(frames[:, :height, :width] - np.stack(pictures))
    assert errors.mean(axis=(1, 2)).max() < 4
    assert [path.stem for path in tmp_path.iterdir()] == ["take.1"]


def test_an_odd_size_doubles_the_last_row_and_column(tmp_path, decode):
    frames, _ = decode(write(tmp_path / "odd", moving_ramp(3, 65, 97)))
    np.testing.assert_allclose(frames[:, -1], frames[:, -2], atol=6)
    np.testing.assert_allclose(frames[:, :, -1], frames[:, :, -2], atol=6)


def test_a_browser_can_start_before_it_has_the_whole_file(tmp_path):
    content = write(tmp_path / "video", moving_ramp(5, 64, 64)).read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")


def test_an_interrupted_video_leaves_the_old_one(tmp_path, decode):
    path = write(tmp_path / "video", moving_ramp(5, 64, 64))
    before = path.read_bytes()

    def interrupt():
        with open_video(tmp_path / "video", (64, 64), 24) as add:
            add(moving_ramp(1, 64, 64)[0])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt()
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_frames_that_opencv_loses_are_reported(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    first, second = moving_ramp(2, 64, 64)
    with pytest.raises(UserError, match=r"video\.webm: cannot be written \(frames are missing"):
        write(tmp_path / "video", [first, second[:32]])
    assert not list(tmp_path.iterdir())


def test_opencv_without_the_codec_is_reported(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    monkeypatch.setattr(cv2, "VideoWriter_fourcc", lambda *code: 0)
    with pytest.raises(UserError, match=r"video\.webm: cannot be written \(this OpenCV lacks VP8: pip install av\)"):
        write(tmp_path / "video", moving_ramp(1, 64, 64))
    assert not list(tmp_path.iterdir())


def test_opencv_says_nothing_on_standard_error(tmp_path, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "av", None)
    write(tmp_path / "video", moving_ramp(2, 64, 64))
    assert capfd.readouterr().err == ""


def test_the_video_of_a_run_moves(tmp_path, tmp_path_factory):
    run = finished_run.opened(tmp_path_factory.getbasetemp())
    frames, rate = by_opencv(write_run_video(run, tmp_path / "video"))
    assert len(frames) == RUN_VIDEO_SECONDS * DEFAULT_FPS
    assert rate == DEFAULT_FPS
    assert frames[0].shape == (run.dataset.height, 2 * run.dataset.width, 3)
    assert frames.std(axis=(1, 2, 3)).min() > 1
    assert frames.std(axis=0).max() > 1
    camera = select_camera(space_time_path(run.dataset.train.cameras, len(frames)), 50)
    images = run.renderer()(camera).images
    expected = 255 * np.hstack([images.lowlight, images.welllit])
    assert np.abs(frames[50] - expected).mean() < 12  # the codec is lossy


@pytest.mark.slow
@pytest.mark.usefixtures("chromium")
def test_a_browser_plays_a_video_to_the_end_in_its_colours(tmp_path, decode):
    colour = [200, 60, 30]
    path = write(tmp_path / "video", [np.full((64, 96, 3), colour, np.uint8)] * 12)
    word, *numbers = browser.played(path, tmp_path / "profile")
    assert word == "ended", numbers
    assert numbers[:2] == ["96", "64"]
    np.testing.assert_allclose([int(number) for number in numbers[2:5]], colour, atol=6)
