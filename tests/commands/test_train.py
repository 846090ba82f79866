"""`python -m l2dgs_jax.train`: a whole run, a killed one, and every mistake."""

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from scenes import edit_json, write_nerfies
from tiny_training import assert_equal_states, tiny

from l2dgs_jax import runs, train
from l2dgs_jax.config import PRESETS
from l2dgs_jax.data import load_dataset
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs import checkpoints, open_run
from l2dgs_jax.runtime import command_line, devices
from l2dgs_jax.runtime.locks import locked
from l2dgs_jax.training import engine, resolve
from l2dgs_jax.visualize.video import video_path

TINY = [
    "--coarse-steps=5",
    "--fine-steps=7",
    "--checkpoint-every=2",
    "--model.plane-size=4",
    "--model.plane-scales=1",
    "--model.hidden=8",
    "--density.start=1",
    "--density.interval=4",
    "--density.grad-threshold=1e-7",
    "--density.max-gaussians=80",
]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_nerfies(tmp_path_factory.mktemp("scene") / "blobs", 10, 24, 18, num_points=40)


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    return os.environ | {"L2DGS_JAX_CACHE": str(tmp_path_factory.mktemp("cache")), "PYTHONWARNINGS": "ignore"}


def command(*arguments):
    return [sys.executable, "-m", "l2dgs_jax.train", *map(str, arguments)]


@pytest.fixture(scope="module")
def finished(scene, environment, tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished") / "run"
    done = subprocess.run(
        command(scene, "--output", folder, *TINY), env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder, done


def read_state(folder, scene):
    _, config = runs.read_settings(folder)
    return checkpoints.load(folder / runs.CHECKPOINT, config, len(load_dataset(scene).train.names)).state


def test_a_run_writes_its_files_and_shows_its_progress(finished):
    folder, done = finished
    metrics = [json.loads(line) for line in (folder / runs.METRICS).read_text().splitlines()]
    assert metrics[-1]["step"] == 12
    assert metrics[-1]["stage"] == "fine"
    assert np.isfinite([metrics[-1]["loss"], metrics[-1]["psnr"]]).all()
    assert cv2.imread(str(folder / runs.CONTACT_SHEET)).std() > 1
    assert cv2.VideoCapture(str(video_path(folder / runs.VIDEO))).get(cv2.CAP_PROP_FRAME_COUNT) > 24
    assert int(open_run(folder, "coarse").state.step) == 5
    assert not list(folder.glob("*.tmp*"))
    assert "12/12" in done.stderr
    assert "low-light" in done.stderr
    assert "Gaussians" in done.stderr


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_same_result(scene, environment, finished, tmp_path):
    folder = tmp_path / "run"
    arguments = command(scene, "--output", folder, *TINY)
    with subprocess.Popen(arguments, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        while process.poll() is None and not (folder / runs.CHECKPOINT).exists():
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
    saved_step = int(read_state(folder, scene).step)
    assert 2 <= saved_step <= 12
    resumed = subprocess.run(
        command(scene, "--output", folder, "--resume"), env=environment, capture_output=True, text=True, check=False
    )
    assert resumed.returncode == 0, resumed.stderr
    state, expected = read_state(folder, scene), read_state(finished[0], scene)
    assert int(state.step) == 12
    for a, b in zip(state.scene.params.gaussians, expected.scene.params.gaussians, strict=True):
        np.testing.assert_array_equal(a, b)
    steps = [json.loads(line)["step"] for line in (folder / runs.METRICS).read_text().splitlines()]
    assert steps == sorted(set(steps))


@pytest.mark.slow
def test_a_run_stopped_and_killed_at_random_times_gives_the_same_result(scene, environment, finished, tmp_path):
    folder, rng, exit_codes = tmp_path / "run", np.random.default_rng(0), []
    for stop_signal in (signal.SIGTERM, signal.SIGKILL, signal.SIGINT, None):
        resume = ["--resume"] if folder.exists() else TINY
        arguments = command(scene, "--output", folder, "--json", *resume)
        with subprocess.Popen(
            arguments, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            if stop_signal:
                assert any("compiling" in line for line in process.stdout)
                time.sleep(rng.uniform(0, 2))
                process.send_signal(stop_signal)
            output, errors = process.communicate()
        exit_codes.append(process.returncode)
        if process.returncode > 0:
            assert process.returncode == 128 + stop_signal, errors
            assert f"--output {folder} --resume" in errors.splitlines()[-1]
            assert json.loads(output.splitlines()[-1])["code"] == process.returncode
        assert "Traceback" not in errors
    assert exit_codes[0] == 128 + signal.SIGTERM
    assert exit_codes[-1] == 0
    state, expected = read_state(folder, scene), read_state(finished[0], scene)
    assert_equal_states(state, expected)


def test_a_second_training_in_a_folder_is_refused(refuses, scene, finished):
    with locked(finished[0]):
        refuses(scene, "--output", finished[0], "--resume", naming=[str(finished[0]), "another process"])


def test_a_run_without_a_checkpoint_starts_from_the_beginning(scene, tmp_path, monkeypatch):
    class ReachedError(Exception):
        pass

    def first_step(states, batches, values, step, **_):
        assert states.step == step == 0
        raise ReachedError

    monkeypatch.setattr(engine, "train_steps", first_step)
    runs.write_settings(tmp_path / "run", str(scene), resolve(tiny(), load_dataset(scene)))
    with pytest.raises(ReachedError):
        train.main([str(scene), "--output", str(tmp_path / "run"), "--resume"])


@pytest.mark.parametrize("process", [0, 1])
def test_only_process_0_checks_the_viewer_and_tensorboard(scene, tmp_path, monkeypatch, process):
    checked = []

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "load_dataset", stop)
    monkeypatch.setattr(train, "tensorboardx", lambda: checked.append("tensorboard"))
    monkeypatch.setattr(train, "check", lambda *_: checked.append("view"))
    monkeypatch.setattr(train.jax, "process_index", lambda: process)
    with pytest.raises(KeyboardInterrupt):
        train.main([str(scene), "--output", str(tmp_path / "run"), "--view", "--tensorboard"])
    assert checked == [["tensorboard", "view"], []][process]


def test_an_interruption_before_the_first_step_prints_one_word(scene, tmp_path, monkeypatch, capsys):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "load_dataset", interrupt)
    with pytest.raises(SystemExit) as caught:
        command_line.run(train.main, [str(scene), "--output", str(tmp_path / "run"), *TINY])
    assert caught.value.code == 128 + signal.SIGINT
    assert capsys.readouterr().err == "stopped\n"
    assert not (tmp_path / "run").exists()


@pytest.fixture
def refuses(monkeypatch, capsys):
    """Asserts that a command line ends in one sentence and exit code 2, before anything is compiled."""

    def compiled(*_, **__):
        raise AssertionError("reached the first compilation")

    monkeypatch.setattr(engine, "train_steps", compiled)
    monkeypatch.setattr(command_line, "use_compilation_cache", lambda: None)

    def check(*arguments, naming):
        with pytest.raises(SystemExit) as caught:
            command_line.run(train.main, list(map(str, arguments)))
        assert caught.value.code == 2
        message = capsys.readouterr().err
        assert message.startswith("error: ")
        assert message.count("\n") == 1
        for part in (*naming, "expected"):
            assert part in message, message

    return check


@pytest.fixture
def damaged(tmp_path):
    return write_nerfies(tmp_path / "damaged", 8, 24, 18, num_points=12)


def test_a_missing_scene_is_refused(refuses, tmp_path):
    refuses(tmp_path / "nonsuch", "--output", tmp_path / "run", naming=["nonsuch"])
    assert not (tmp_path / "run").exists()


def test_an_empty_folder_is_refused(refuses, tmp_path):
    (tmp_path / "empty").mkdir()
    refuses(tmp_path / "empty", "--output", tmp_path / "run", naming=["empty"])


def test_a_damaged_image_is_refused_and_leaves_no_run(refuses, damaged, tmp_path):
    image = next((damaged / "rgb" / "1x").iterdir())
    image.write_bytes(b"not a picture")
    refuses(damaged, "--output", tmp_path / "run", naming=[image.name])
    assert not (tmp_path / "run").exists()


def test_nan_in_a_pose_is_refused(refuses, damaged, tmp_path):
    camera = sorted((damaged / "camera").iterdir())[2]
    edit_json(camera, position=[0.0, float("nan"), 0.0])
    refuses(damaged, "--output", tmp_path / "run", naming=[camera.name])


def test_an_unknown_preset_is_refused(refuses, scene, tmp_path):
    refuses(scene, "--preset", "nonsuch", "--output", tmp_path / "run", naming=["nonsuch", "default", "paper"])


def test_counts_of_zero_are_refused(refuses, scene, tmp_path):
    for option in ("--batch-size=0", "--batch-size=-1", "--checkpoint-every=0", "--keep-checkpoints=0"):
        refuses(scene, option, "--output", tmp_path / "run", naming=[option.split("=")[0], "at least 1"])
        assert not (tmp_path / "run").exists()
    refuses(scene, "--coarse-steps=0", "--fine-steps=0", "--output", tmp_path / "run", naming=["--coarse-steps"])


def test_an_output_that_holds_another_run_is_refused(refuses, scene, finished):
    refuses(scene, "--output", finished[0], naming=[str(finished[0]), "--resume"])


def test_an_output_that_is_a_file_is_refused(refuses, scene, tmp_path):
    (tmp_path / "file").write_text("")
    refuses(scene, "--output", tmp_path / "file", naming=["file"])


def test_an_output_that_cannot_be_made_is_refused(refuses, scene, tmp_path):
    (tmp_path / "file").write_text("")
    refuses(scene, "--output", tmp_path / "file" / "run", naming=["file/run"])


def test_resuming_without_a_run_is_refused(refuses, scene, tmp_path):
    refuses(scene, "--output", tmp_path / "nonsuch", "--resume", naming=["nonsuch"])


def test_resuming_with_other_settings_is_refused(refuses, scene, finished):
    refuses(
        scene,
        "--output",
        finished[0],
        "--resume",
        "--optim.reflectance-lr=0.5",
        naming=["checkpoint.npz", "optim.reflectance_lr"],
    )


def run_without_checkpoint(folder, scene):
    runs.write_settings(folder, str(scene), resolve(tiny(), load_dataset(scene)))
    return folder


def test_resuming_with_other_settings_before_the_first_checkpoint_is_refused(refuses, scene, tmp_path):
    folder = run_without_checkpoint(tmp_path / "run", scene)
    named = ["config.json", "model.hidden was 8, is 16"]
    refuses(scene, "--output", folder, "--resume", "--model.hidden=16", "--keep-checkpoints=3", naming=named)


def test_resuming_with_a_preset_is_refused(refuses, scene, tmp_path):
    folder = run_without_checkpoint(tmp_path / "run", scene)
    refuses(scene, "--output", folder, "--resume", "--preset=fast", naming=["--preset fast", "--resume"])


def test_resuming_on_another_scene_is_refused(refuses, scene, damaged, tmp_path):
    folder = run_without_checkpoint(tmp_path / "run", scene)
    for other in (damaged, "demo"):
        refuses(other, "--output", folder, "--resume", naming=[str(other), str(folder), str(scene)])
    (tmp_path / "link").symlink_to(scene)
    assert train._parse([str(tmp_path / "link"), "--output", str(folder), "--resume"]).output == folder


def test_a_run_resumes_on_a_scene_that_has_been_moved(damaged, tmp_path, monkeypatch):
    folder = run_without_checkpoint(tmp_path / "run", damaged)
    before = runs.read_settings(folder)[1]
    damaged.rename(tmp_path / "moved")

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "_record", stop)
    with pytest.raises(KeyboardInterrupt):
        train.main([str(tmp_path / "moved"), "--output", str(folder), "--resume", "--keep-checkpoints=3"])
    assert runs.read_settings(folder) == (str(tmp_path / "moved"), before)


def test_resuming_from_a_truncated_checkpoint_is_refused(refuses, scene, finished, tmp_path):
    (tmp_path / runs.SETTINGS).write_bytes((finished[0] / runs.SETTINGS).read_bytes())
    (tmp_path / runs.CHECKPOINT).write_bytes((finished[0] / runs.CHECKPOINT).read_bytes()[:1000])
    refuses(scene, "--output", tmp_path, "--resume", naming=["checkpoint.npz", "truncated"])


def test_what_cannot_start_leaves_no_folder(refuses, scene, tmp_path, monkeypatch):
    def refuse_mesh(views):
        raise ValueError("2 devices leave some of the 3 processes without any")

    monkeypatch.setattr(devices, "mesh", refuse_mesh)
    refuses(scene, "--output", tmp_path / "run", naming=["--devices", "without any"])
    monkeypatch.undo()
    option = "--optim.extent-scales"
    refuses(scene, option, "means", "plane", "--output", tmp_path / "run", naming=[option, "planes"])
    refuses(scene, "--density.spread=1", "--output", tmp_path / "run", naming=["--density.spread 1"])
    tone = ("--model.domain", "light", "--model.tone", "1.2")
    refuses(scene, *tone, "--output", tmp_path / "run", naming=["--model.tone 1.2", "--model.domain values"])
    unlit = "--model.initial-illumination"
    refuses(scene, unlit, "None", "--output", tmp_path / "run", naming=[f"{unlit} None", "--model.relative-light"])
    refuses(scene, "--model.plane-size=1", "--output", tmp_path / "run", naming=["--model.plane-size 1", "at least 2"])
    assert not (tmp_path / "run").exists()
    (tmp_path / "file").write_text("")
    refuses(scene, "--output", tmp_path / "file" / "run", naming=["--output", str(tmp_path / "file" / "run")])


def test_a_warning_is_shown_without_progress_too(scene, tmp_path, monkeypatch, capsys):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "misfit", lambda *_: "22 frames are few")
    monkeypatch.setattr(train, "_fit", stop)
    with pytest.raises(KeyboardInterrupt):
        train.main([str(scene), "--output", str(tmp_path / "run"), "--quiet", *TINY])
    assert capsys.readouterr() == ("", "warning: 22 frames are few\n")


def test_options_of_the_run_are_read_together_with_a_preset(scene, tmp_path):
    flags = ["--quiet", "--json", "--no-report", "--tensorboard", "--devices=1"]
    options = train._parse([str(scene), *flags, "--preset=fast", "--output", str(tmp_path / "run"), "--fine-steps=7"])
    assert (options.quiet, options.json, options.report, options.tensorboard) == (True, True, False, True)
    assert (options.devices, options.config.fine_steps, options.config.coarse_steps) == (1, 7, 100)
    assert not options.resume


def test_a_run_on_the_folder_above_is_named_after_it(scene, monkeypatch):
    monkeypatch.chdir(scene / "rgb")
    options = train._parse([".."])
    assert options.output == Path("runs") / scene.name
    assert options.scene == str(scene.resolve())


def shown_default(capsys, arguments, option):
    with pytest.raises(SystemExit) as caught:
        train.main(arguments)
    assert caught.value.code == 0
    help_text = capsys.readouterr().out.split(f" {option} ")[1]
    return re.search(r"\(default: (\S+)\)", help_text)[1]


@pytest.mark.parametrize(
    ("arguments", "preset"),
    [
        (["--help"], "default"),
        (["nonsuch", "-h"], "default"),
        (["demo", "--help"], "demo"),
        (["--preset", "paper", "--help"], "paper"),
        (["--help", "demo", "--preset=best"], "best"),
    ],
)
def test_help_shows_the_settings_of_the_preset(capsys, arguments, preset):
    config = PRESETS[preset]
    assert shown_default(capsys, arguments, "--preset") == preset
    assert shown_default(capsys, arguments, "--fine-steps") == str(config.fine_steps)
    assert shown_default(capsys, arguments, "--model.tone") == config.model.tone
    assert shown_default(capsys, arguments, "--optim.heads-lr") == str(config.optim.heads_lr)


def test_help_on_an_unknown_preset_is_refused(refuses):
    refuses("--preset", "nonsuch", "--help", naming=["nonsuch", "default", "paper"])


def test_an_unknown_option_is_refused(capsys, scene):
    with pytest.raises(SystemExit) as caught:
        command_line.run(train.main, [str(scene), "--nonsuch=1"])
    assert caught.value.code == 2
    assert "nonsuch" in capsys.readouterr().err


def test_a_wrong_layout_or_held_out_rule_is_refused(refuses, scene, tmp_path):
    refuses(scene, "--format=llff", "--output", tmp_path / "run", naming=["poses_bounds.npy"])
    refuses(scene, "--held-out=every", "--output", tmp_path / "run", naming=["--held-out every", "4dgs"])


def test_resuming_and_opening_use_the_data_settings_of_the_run(scene, tmp_path, monkeypatch):
    options = {"downscale": 2, "format": "nerfies", "held_out": "5", "frame_memory": 0.5, "normalise": False}
    config = dataclasses.replace(PRESETS["demo"], **options)
    runs.write_settings(tmp_path, str(scene), config)
    assert train._parse([str(scene), "--output", str(tmp_path), "--resume"]).config == config

    def stop(*arguments, **options):
        raise UserError(repr((arguments, options)))

    monkeypatch.setattr(sys.modules["l2dgs_jax.runs.folder"], "load_dataset", stop)
    (tmp_path / runs.CHECKPOINT).write_bytes(b"")
    with pytest.raises(UserError) as caught:
        runs.open_run(tmp_path)
    assert str(caught.value) == repr(((str(scene),), options))
