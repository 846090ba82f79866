"""`python -m l2dgs_jax.simulate`: the low-light twin that it writes, its report, and every mistake."""

import json
import shutil

import cv2
import jax
import numpy as np
import pytest
import skimage.data
from scenes import write_nerfies
from scipy.stats import spearmanr

from l2dgs_jax import simulate
from l2dgs_jax.data import load_dataset
from l2dgs_jax.data.images import area_average
from l2dgs_jax.preprocess.lowlight import DarkeningConfig, curve_network, darkening, weights
from l2dgs_jax.runtime import command_line


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_nerfies(tmp_path_factory.mktemp("scene") / "blobs", truth=True)


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setattr(command_line, "use_compilation_cache", lambda: None)


def run(*arguments):
    command_line.run(simulate.main, list(map(str, arguments)))


def report(folder):
    return json.loads((folder / simulate.SETTINGS).read_text())


def to_bytes(images):
    return np.rint(255 * np.asarray(images, float))


@pytest.fixture
def refuses(capsys, tmp_path):
    """Asserts that a command line ends in one sentence and exit code 2, and leaves no output."""

    def check(*arguments, naming):
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(SystemExit) as caught:
            run(*arguments)
        assert caught.value.code == 2
        message = capsys.readouterr().err.splitlines()[-1]
        assert message.startswith("error: ")
        for part in (*naming, "expected"):
            assert part in message, message
        assert sorted(tmp_path.rglob("*")) == before

    return check


@pytest.mark.parametrize("method", ["network", "analytic", "camera"])
def test_the_twin_is_the_same_scene_in_the_dark(scene, tmp_path, capsys, method):
    run(scene, tmp_path / "twin", "--method", method, "--exposure", 0.06)
    source, twin = load_dataset(scene, normalise=False), load_dataset(tmp_path / "twin")
    frames = report(tmp_path / "twin")["frames"]
    assert set(frames) == {*source.train.names, *source.test.names}
    for before, after in ((source.train, twin.train), (source.test, twin.test)):
        assert after.names == before.names
        np.testing.assert_allclose(after.cameras.viewmat, before.cameras.viewmat, atol=1e-6)
        np.testing.assert_allclose(after.cameras.time, before.cameras.time)
        np.testing.assert_array_equal(after.masks, before.masks)
        well, low = to_bytes(after.welllit), to_bytes(after.images)
        np.testing.assert_array_equal(well, to_bytes(before.welllit))
        assert np.all(low <= well)
        assert low.mean() < 0.4 * well.mean()
        for name, dark, bright in zip(after.names, low, well, strict=True):
            psnr = -10 * np.log10(np.mean(((dark - bright) / 255) ** 2))
            np.testing.assert_allclose(frames[name]["psnr"], psnr, atol=1e-3)
            np.testing.assert_allclose(frames[name]["level"], dark.mean() / 255, atol=1e-5)
            assert frames[name]["exposure"] == 0.06
    assert twin.colors is None
    np.testing.assert_allclose(twin.points, source.points)
    assert cv2.imread(str(tmp_path / "twin" / simulate.CONTACT_SHEET)).std() > 1
    assert "PSNR(low, well)" in capsys.readouterr().out


def test_without_truth_the_frames_themselves_are_darkened(scene, tmp_path):
    shutil.copytree(scene, tmp_path / "plain", ignore=shutil.ignore_patterns("well", "mask"))
    run(tmp_path / "plain", tmp_path / "twin", "--downscale", 2, "--exposure", 0.03)
    source, twin = load_dataset(tmp_path / "plain", 2), load_dataset(tmp_path / "twin")
    np.testing.assert_array_equal(to_bytes(twin.train.welllit), to_bytes(source.train.images))
    assert twin.train.masks is None


def test_exposure_is_drawn_per_video_or_per_image_from_the_seed(scene, tmp_path):
    drawn = {}
    for name, options in {"video": [], "again": [], "other": ["--seed", 1], "image": ["--per-image"]}.items():
        run(scene, tmp_path / name, *options)
        drawn[name] = [frame["exposure"] for frame in report(tmp_path / name)["frames"].values()]
    assert len(set(drawn["video"])) == 1
    assert drawn["video"] == drawn["again"] != drawn["other"]
    assert len(set(drawn["image"])) == 8
    low, high = DarkeningConfig.exposure_range
    assert all(low <= exposure <= high for exposures in drawn.values() for exposure in exposures)
    assert to_bytes(load_dataset(tmp_path / "image").train.images).mean((1, 2, 3)).std() > 0.5


def test_a_drifting_exposure_changes_the_light_slowly(scene, tmp_path):
    steady = ["--exposure", 0.06]
    for name, options in {"steady": steady, "drifting": [*steady, "--exposure-drift", 0.3]}.items():
        run(scene, tmp_path / name, *options)
    frames = report(tmp_path / "drifting")["frames"]
    splits = [getattr(load_dataset(tmp_path / "drifting"), part) for part in ("train", "test")]
    times = {name: time for split in splits for name, time in zip(split.names, split.cameras.time, strict=True)}
    lights = np.array([frames[name]["light"] for name in sorted(times, key=times.get)])
    assert np.all(np.abs(lights - 1) <= 0.3)
    assert np.ptp(lights) > 0.3
    before = {name: frame["level"] for name, frame in report(tmp_path / "steady")["frames"].items()}
    darker = [name for name, frame in frames.items() if frame["light"] < 0.95]
    assert all(frames[name]["level"] < before[name] for name in darker)
    assert {frame["light"] for frame in report(tmp_path / "steady")["frames"].values()} == {1.0}


def test_noise_is_seeded_and_differs_from_frame_to_frame(scene, tmp_path):
    noisy = ["--exposure", 0.06, "--photons", 300]
    for name, options in {"clean": noisy[:2], "one": noisy, "same": noisy, "two": [*noisy, "--seed", 1]}.items():
        run(scene, tmp_path / name, *options)
    clean, one, same, two = (to_bytes(load_dataset(tmp_path / n).train.images) for n in ("clean", "one", "same", "two"))
    np.testing.assert_array_equal(one, same)
    assert (one != two).any()
    assert (one[0] - clean[0] != one[1] - clean[1]).any()


def test_a_brightening_network_changes_nothing_unless_allowed(scene, tmp_path):
    """The network, given by --weights, brightens everything."""
    zeros = jax.tree.map(
        lambda leaf: np.zeros(leaf.shape, np.float32), jax.eval_shape(lambda: curve_network.init(jax.random.key(0), 2))
    )
    zeros.image[6].bias[0] = -0.5
    weights.save(tmp_path / "up.npz", zeros)
    for name, options in {"kept": [], "raised": ["--allow-brightening"]}.items():
        run(scene, tmp_path / name, "--method", "network", "--weights", tmp_path / "up.npz", *options)
    assert {frame["psnr"] for frame in report(tmp_path / "kept")["frames"].values()} == {None}
    assert report(tmp_path / "kept")["mean"]["psnr"] is None
    raised = report(tmp_path / "raised")["mean"]
    assert raised["level"] > raised["welllit_level"]


@pytest.mark.parametrize(
    ("options", "naming"),
    [
        (["--exposure", "0"], ["--exposure"]),
        (["--exposure", "nan"], ["--exposure"]),
        (["--exposure-range", "0.2", "0.1"], ["--exposure-range", "0.2 ... 0.1"]),
        (["--exposure-range", "0.2", "1"], ["--exposure-range"]),
        (["--exposure", "0.7"], ["blobs", "0.700", "--exposure"]),
        (["--exposure-drift", "1"], ["--exposure-drift 1"]),
        (["--photons", "0"], ["--photons"]),
        (["--photons", "inf"], ["--photons"]),
        (["--seed", "-1"], ["--seed -1"]),
        (["--photons", "9", "--read-noise", "-1"], ["--read-noise"]),
        (["--read-noise", "5"], ["--read-noise", "--photons"]),
        (["--weights", "some.npz"], ["--weights", "--method"]),
        (["--method", "network", "--weights", "nonsuch.pth"], ["nonsuch.pth"]),
        (["--downscale", "0"], ["--downscale"]),
    ],
)
def test_invalid_options_are_refused(scene, tmp_path, refuses, options, naming):
    refuses(scene, tmp_path / "twin", *options, naming=naming)


def test_invalid_folders_are_refused(scene, tmp_path, refuses):
    refuses(tmp_path / "nonsuch", tmp_path / "twin", naming=["nonsuch"])
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    refuses(scene, tmp_path / "full", naming=["full: exists already"])
    (tmp_path / "file").write_text("mine")
    refuses(scene, tmp_path / "file" / "twin", naming=["twin: cannot be written"])


def test_truth_of_one_split_only_is_refused(scene, tmp_path, refuses):
    shutil.copytree(scene, tmp_path / "half")
    for name in load_dataset(scene).train.names:
        (tmp_path / "half" / "well" / "1x" / f"{name}.png").unlink()
    refuses(tmp_path / "half", tmp_path / "twin", naming=["half", "one split only"])


@pytest.mark.parametrize("name", ["stereo_motorcycle", "retina"])
def test_the_shipped_network_darkens_unseen_photographs(name):
    photograph = getattr(skimage.data, name)()
    image = area_average((photograph[0] if name == "stereo_motorcycle" else photograph).astype(np.float32) / 255, 4)
    darkener = darkening.network_darkener(weights.load())
    levels = []
    for exposure in (0.04, 0.08):
        dark = darkening.darken(image, exposure, darkener, "correct", brighten=True)
        assert np.all(dark <= image + 1 / 255)
        low = darkening.truncate(dark).astype(np.float32) / 255
        assert spearmanr(darkening.lightness(image).ravel(), darkening.lightness(low).ravel())[0] > 0.9
        levels.append(low.mean())
    assert levels[0] < 0.8 * levels[1]
