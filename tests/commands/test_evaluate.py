"""Scores of a run compared with plain NumPy and scikit-image, and the command that prints them."""

import dataclasses
import json
import os
import subprocess
import sys

import finished_run
import networks
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from skimage.metrics import structural_similarity

from l2dgs_jax import metrics, runs
from l2dgs_jax.cameras.geometry import select_camera
from l2dgs_jax.data import load_dataset
from l2dgs_jax.errors import UserError
from l2dgs_jax.evaluate import evaluate, main, table
from l2dgs_jax.metrics.flip import flip_map
from l2dgs_jax.metrics.lpips import SMALLEST_SIDE
from l2dgs_jax.runs.lpips_weights import load_lpips
from l2dgs_jax.runs.views import views
from l2dgs_jax.runtime import command_line
from l2dgs_jax.training.flows import Flows


@pytest.fixture(autouse=True)
def _no_compilation_cache(monkeypatch):
    monkeypatch.setenv("L2DGS_JAX_CACHE", "off")


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.getbasetemp()


@pytest.fixture(scope="module")
def run(base):
    return finished_run.opened(base)


@pytest.fixture(scope="module")
def result(run):
    return evaluate(run)


@pytest.fixture(scope="module")
def rendered(run):
    split, renderer = run.dataset.test, run.renderer()
    outputs = [renderer(select_camera(split.cameras, i)).images for i in range(len(split.names))]
    as_double = lambda images: np.stack(images).astype(np.float64)
    return {
        "lowlight": as_double([output.lowlight for output in outputs]),
        "welllit": as_double([output.welllit for output in outputs]),
        "input": as_double(split.images),
        "truth": as_double(split.welllit),
        "masks": split.masks,
    }


def psnr(prediction, truth, masks=None):
    masks = np.ones(truth.shape[:-1], bool) if masks is None else masks
    frames = zip(prediction, truth, masks, strict=True)
    return np.mean([-10 * np.log10(np.mean((p[m] - t[m]) ** 2)) for p, t, m in frames if m.any()])


def ssim(prediction, truth, masks=None):
    """Mean over windows inside the image, or over those of them centred on pixels of a mask."""
    scores, inside = [], (slice(5, -5), slice(5, -5))
    for i, (p, t) in enumerate(zip(prediction, truth, strict=True)):
        mean, similarity = structural_similarity(
            p, t, gaussian_weights=True, use_sample_covariance=False, channel_axis=-1, data_range=1.0, full=True
        )
        if masks is None:
            scores.append(mean)
        elif masks[i][inside].any():
            scores.append(similarity[inside][masks[i][inside]].mean())
    return np.mean(scores)


def regions(masks):
    return {"overall": None, "dynamic": masks, "static": ~masks}


def best_gain(prediction, truth):
    """The gain found by search, with saturation."""
    error = lambda gain: np.square(np.clip(gain * prediction, 0, 1) - truth).mean()
    start = np.linalg.lstsq(prediction.reshape(-1, 1), truth.ravel())[0].item()
    return minimize_scalar(error, bounds=(start / 2, start * 2), method="bounded", options={"xatol": 1e-6}).x


def test_counts_of_frames_steps_and_gaussians(result, run):
    assert result["frames"] == len(finished_run.HELD_OUT)
    assert (result["split"], result["stage"], result["step"]) == ("test", "fine", 6)
    assert result["gaussians"] == int(np.sum(run.state.scene.alive))
    assert json.loads(json.dumps(result)) == result


def test_frames_in_a_file_score_the_same(run, result):
    scene, _ = runs.read_settings(run.folder)
    assert evaluate(dataclasses.replace(run, dataset=load_dataset(scene, frame_memory=0.0))) == result


def test_lowlight_scores_match_scikit_image(result, rendered):
    for region, masks in regions(rendered["masks"]).items():
        scores = result["lowlight"] if region == "overall" else result["lowlight_regions"][region]
        assert set(scores) == {"psnr", "ssim", "area"}
        np.testing.assert_allclose(scores["psnr"], psnr(rendered["lowlight"], rendered["input"], masks), atol=1e-3)
        np.testing.assert_allclose(scores["ssim"], ssim(rendered["lowlight"], rendered["input"], masks), atol=1e-3)
        shown = [1.0] if masks is None else [mask.mean() for mask in masks if mask.any()]
        np.testing.assert_allclose(scores["area"], np.mean(shown))
    np.testing.assert_allclose(result["mask_area"], rendered["masks"].mean())


def test_a_scene_of_brightened_frames_has_no_low_light_score(run, result):
    brightened = dataclasses.replace(run, config=dataclasses.replace(run.config, enhance="gamma"))
    scores = evaluate(brightened)
    assert result.keys() - scores.keys() == {"lowlight", "lowlight_gain", "lowlight_regions"}
    assert scores["welllit"] == result["welllit"]
    assert "low light" not in table(scores)


def test_with_drifting_exposures_each_low_light_frame_is_scored_with_its_own_gain(run, result, rendered):
    assert result["lowlight_gain"] == "none"
    params = run.state.scene.params._replace(exposures=np.zeros((len(run.dataset.train.names), 3), np.float32))
    drifting = dataclasses.replace(run, state=run.state._replace(scene=run.state.scene._replace(params=params)))
    scores = evaluate(drifting)
    assert scores["lowlight_gain"] == "own"
    assert "low light x gain" in table(scores)
    pairs = zip(rendered["lowlight"], rendered["input"], strict=True)
    gained = [np.clip(metrics.best_gain([(estimate, seen)]) * estimate, 0, 1) for estimate, seen in pairs]
    np.testing.assert_allclose(scores["lowlight"]["psnr"], psnr(gained, rendered["input"]), atol=1e-3)
    assert scores["lowlight"]["psnr"] > result["lowlight"]["psnr"]
    assert scores["welllit"] == result["welllit"]


def test_welllit_scores_match_scikit_image(result, rendered):
    gain = best_gain(rendered["welllit"], rendered["truth"])
    np.testing.assert_allclose(result["gain"], gain, rtol=1e-3)
    gained = np.clip(gain * rendered["welllit"], 0, 1)
    assert set(result["welllit"]) == {"overall", "dynamic", "static"}
    for region, masks in regions(rendered["masks"]).items():
        for suffix, prediction in (("", rendered["welllit"]), ("_gain", gained)):
            scores = {key: result["welllit"][region][key + suffix] for key in ("psnr", "ssim")}
            np.testing.assert_allclose(scores["psnr"], psnr(prediction, rendered["truth"], masks), atol=1e-2)
            np.testing.assert_allclose(scores["ssim"], ssim(prediction, rendered["truth"], masks), atol=1e-3)
    assert result["welllit"]["overall"]["psnr_gain"] >= result["welllit"]["overall"]["psnr"] - 0.1


def test_further_scores_are_present_or_null(result, rendered):
    overall = result["welllit"]["overall"]
    found = np.mean([flip_map(p, t).mean() for p, t in zip(rendered["welllit"], rendered["truth"], strict=True)])
    np.testing.assert_allclose(overall["flip"], found, atol=1e-3)
    assert overall["ssim_3dgs"] != overall["ssim"]
    for name in ("ms_ssim", "lpips_alex", "lpips_vgg"):  # the images are small, and there are no weights
        assert overall[name] is overall[f"{name}_gain"] is None
    assert "LPIPS needs weights" in table(result)


def test_lpips_of_a_region_in_the_papers_convention_is_proportional_to_its_area(run, monkeypatch, tmp_path):
    monkeypatch.setitem(metrics.NETWORKS, "alex", networks.TINY)
    monkeypatch.setitem(SMALLEST_SIDE, "alex", 1)
    np.savez(tmp_path / "tiny.npz", **networks.state_dict("alex"))
    weights = load_lpips("alex", [tmp_path / "tiny.npz"])
    found = evaluate(run, lpips={"alex": weights}, convention="paper")
    assert found["region_convention"] == "paper"
    frames = {region: scores["lpips_alex_gain"] for region, scores in found["welllit"].items()}
    assert frames["overall"] > 0
    np.testing.assert_allclose(frames["static"] / frames["overall"], found["welllit"]["static"]["area"], rtol=0.05)
    np.testing.assert_allclose(frames["dynamic"] + frames["static"], frames["overall"])
    assert f"LPIPS (AlexNet) {frames['overall']:.3f}" in table(found)
    assert "LPIPS needs weights" not in table(found)


def test_the_dark_frame_is_scored_with_its_best_gain(result, rendered):
    gain = best_gain(rendered["input"], rendered["truth"])
    assert gain > 3
    gained = np.clip(gain * rendered["input"], 0, 1)
    reference = result["dark_frame_gain"]
    np.testing.assert_allclose(reference["gain"], gain, rtol=1e-4)
    np.testing.assert_allclose(reference["psnr_gain"], psnr(gained, rendered["truth"]), atol=1e-3)
    np.testing.assert_allclose(reference["ssim_gain"], ssim(gained, rendered["truth"]), atol=1e-3)


def test_without_truth_or_masks_only_the_low_light_is_scored(run):
    bare = finished_run.without_truth_and_test(run)
    result = evaluate(bare, "train")
    assert not {"welllit", "gain", "dark_frame_gain", "lowlight_regions", "mask_area"} & set(result)
    assert result["frames"] == len(run.dataset.train.names)
    with_masks = dataclasses.replace(bare.dataset, train=dataclasses.replace(run.dataset.train, welllit=None))
    result = evaluate(dataclasses.replace(bare, dataset=with_masks), "train")
    assert set(result["lowlight_regions"]) == {"dynamic", "static"}
    assert "welllit" not in result


def test_a_split_without_views_is_refused(run):
    with pytest.raises(UserError, match="has no test views; expected some, or --split train"):
        evaluate(finished_run.without_truth_and_test(run))


def test_the_table_shows_every_score(result):
    lines = table(result).splitlines()
    assert lines[0] == "2 test views, fine stage, step 6"
    overall = next(line for line in lines if line.startswith("well-lit")).split()[1:]
    scores = result["welllit"]["overall"]
    assert overall == [
        f"{scores['psnr']:.2f}",
        f"{scores['ssim']:.3f}",
        f"{scores['psnr_gain']:.2f}",
        f"{scores['ssim_gain']:.3f}",
        "100.0%",
    ]
    dark = next(line for line in lines if line.startswith("dark frame"))
    header = lines[1]
    assert dark.index(f"{result['dark_frame_gain']['psnr_gain']:.2f}") > header.index("SSIM")
    assert sum(line.startswith("  dynamic") for line in lines) == 2


def test_the_command_writes_what_evaluate_returns(base, result, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("l2dgs_jax.evaluate.find_lpips", lambda files: {})  # even if weights are installed
    file = tmp_path / "scores.json"
    file.write_text("old")
    command_line.run(main, [str(finished_run.folder(base)), "--json", str(file)])
    assert json.loads(file.read_text()) == result
    assert [p.name for p in tmp_path.iterdir()] == ["scores.json"]
    assert capsys.readouterr().out.strip() == table(result)


def test_the_command_scores_the_coarse_stage_and_the_training_views(base, result, tmp_path, capsys):
    run_folder = str(finished_run.folder(base))
    command_line.run(
        main, [run_folder, "--stage", "coarse", "--split", "train", "--json", str(tmp_path / "coarse.json")]
    )
    coarse = json.loads((tmp_path / "coarse.json").read_text())
    assert (coarse["stage"], coarse["step"], coarse["split"]) == ("coarse", 3, "train")
    assert coarse["frames"] == finished_run.FRAMES - len(finished_run.HELD_OUT)
    assert coarse["lowlight"] != result["lowlight"]
    assert "8 train views, coarse stage, step 3" in capsys.readouterr().out


def test_a_separate_process_in_single_precision_gives_the_same_scores(base, result, tmp_path):
    file = tmp_path / "scores.json"
    command = [sys.executable, "-m", "l2dgs_jax.evaluate", str(finished_run.folder(base)), "--json", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ | {"JAX_ENABLE_X64": "0"})
    assert done.stdout.startswith("2 test views")
    single = json.loads(file.read_text())
    for scores, expected in (
        (single["lowlight"], result["lowlight"]),
        (single["welllit"]["overall"], result["welllit"]["overall"]),
    ):
        known = {name: score for name, score in expected.items() if not name.startswith("lpips")}
        assert {name: scores[name] for name in known} == pytest.approx(known, abs=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{missing}"], "missing: not a training run; expected a folder with config.json"),
        (["{empty}"], "empty: not a training run; expected a folder with config.json"),
        (
            ["{run}", "--json", "{missing}/scores.json"],
            "scores.json: cannot be written; expected a file in a writable",
        ),
        (["{run}", "--json", "{empty}"], "empty: cannot be written; expected a file in a writable folder"),
        (["{run}", "--json", "{run}/config.json"], "config.json: a file of the run itself; expected another one"),
        (
            ["{run}", "--lpips-alex", "{missing}.npz"],
            "missing.npz: cannot be read (No such file or directory); expected",
        ),
    ],
)
def test_invalid_input_gives_one_sentence_and_exit_2(base, tmp_path, capsys, arguments, message):
    (tmp_path / "empty").mkdir()
    paths = {"missing": tmp_path / "missing", "empty": tmp_path / "empty", "run": finished_run.folder(base)}
    with pytest.raises(SystemExit) as caught:
        command_line.run(main, [argument.format(**paths) for argument in arguments])
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1


def test_a_run_without_a_coarse_checkpoint_is_refused(base, tmp_path, capsys):
    scene, config = runs.read_settings(finished_run.folder(base))
    runs.write_settings(tmp_path / "young", scene, config)
    with pytest.raises(SystemExit) as caught:
        command_line.run(main, [str(tmp_path / "young"), "--stage", "coarse"])
    assert caught.value.code == 2
    assert "coarse.npz: no such checkpoint; expected a run that has got that far" in capsys.readouterr().err


def test_invalid_pixels_are_ignored_and_covisible_ones_scored(run, result, rendered):
    split = run.dataset.test
    rng = np.random.default_rng(0)
    valid, seen = (rng.random(split.masks.shape) < share for share in (0.8, 0.5))
    results = []
    for wrong in (0, 1):
        spoil = lambda images, wrong=wrong: np.where(valid[..., None], images, wrong).astype(np.float16)
        test = dataclasses.replace(
            split, images=spoil(split.images), welllit=spoil(split.welllit), valid=valid, covisible=seen
        )
        results.append(evaluate(dataclasses.replace(run, dataset=dataclasses.replace(run.dataset, test=test))))
    flowless = [{key: scores for key, scores in found.items() if key != "temporal"} for found in results]
    assert flowless[0] == flowless[1]  # optical flow uses all pixels
    found = results[0]
    assert found["lowlight_regions"].keys() == {"dynamic", "static", "covisible"}
    assert found["welllit"].keys() == {"overall", "dynamic", "static", "covisible"}
    for region, masks in (("covisible", valid & seen), ("static", valid & ~split.masks)):
        expected = psnr(rendered["lowlight"], rendered["input"], masks)
        np.testing.assert_allclose(found["lowlight_regions"][region]["psnr"], expected, atol=1e-4)
    np.testing.assert_allclose(
        found["lowlight"]["psnr"], psnr(rendered["lowlight"], rendered["input"], valid), atol=1e-4
    )
    assert "covisible" in table(found)
    assert "covisible" not in table(result)


def test_a_frame_with_nan_is_named_and_means_are_null(run, result, monkeypatch):
    def spoiled(*arguments):
        for index, output in enumerate(views(*arguments)):
            images = output.images
            if index == 1:
                dots = np.where(np.arange(images.welllit.size).reshape(images.welllit.shape) % 50, 0, np.nan)
                images = images._replace(welllit=images.welllit + dots, lowlight=images.lowlight + dots)
            yield output._replace(images=images)

    monkeypatch.setattr("l2dgs_jax.runs.scores.views", spoiled)
    with pytest.warns(UserWarning, match=f"not finite, and without a score: test views {run.dataset.test.names[1]}$"):
        found = evaluate(run)
    assert found["lowlight"] == {"psnr": None, "ssim": None, "area": 1.0}
    assert {score for name, score in found["welllit"]["static"].items() if name != "area"} == {None}
    assert found["gain"] is found["temporal"]["regions"]["overall"]["warping_error"] is None
    assert found["dark_frame_gain"] == result["dark_frame_gain"]
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert "gain unknown" in table(found)


def test_a_single_infinite_value_leaves_its_frames_score_unknown(run, monkeypatch):
    """A pixel without trusted flow: the warping error of the images as rendered is then known, the other is not."""

    def spoiled(*arguments):
        for output in views(*arguments):
            images = output.images
            welllit, lowlight = (np.array(x) for x in (images.welllit, images.lowlight))
            welllit[0, 0, 0] = lowlight[0, 0, 0] = np.inf
            yield output._replace(images=images._replace(welllit=welllit, lowlight=lowlight))

    def untrusted(split):
        height, width = split.images.shape[1:3]
        displacements = np.zeros((len(split.names), 2, height, width, 2), np.float16)
        displacements[..., 0, 0, :] = np.nan
        following = np.minimum(np.arange(len(split.names)) + 1, len(split.names) - 1)
        return Flows(following, displacements)

    monkeypatch.setattr("l2dgs_jax.runs.scores.views", spoiled)
    monkeypatch.setattr("l2dgs_jax.runs.steadiness.neighbour_flows", untrusted)
    with pytest.warns(UserWarning, match="not finite, and without a score"):
        found = evaluate(run)
    assert found["lowlight"] == {"psnr": None, "ssim": None, "area": 1.0}
    assert found["welllit"]["overall"]["psnr"] is None
    scores = found["temporal"]["regions"]["overall"]
    assert scores["warping_error"] is not None
    assert scores["warping_error_gain"] is None
    assert f"warping error {scores['warping_error']:.5f}" in table(found)


def test_a_split_without_valid_pixels_is_refused(run):
    test = dataclasses.replace(run.dataset.test, valid=np.zeros(run.dataset.test.masks.shape, bool))
    with pytest.raises(UserError, match="no pixel of its scene's test views is valid; expected"):
        evaluate(dataclasses.replace(run, dataset=dataclasses.replace(run.dataset, test=test)))
