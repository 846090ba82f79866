"""The command that writes a run in the formats of other programs."""

import dataclasses
import json
import subprocess
import sys

import finished_run
import jax
import numpy as np
import pytest

from l2dgs_jax import export
from l2dgs_jax.data import clouds
from l2dgs_jax.exporters import web_page
from l2dgs_jax.exporters.splats import Splats
from l2dgs_jax.runs import open_run
from l2dgs_jax.runtime import command_line

SUFFIXES = {"ply": ".ply", "splat": ".splat", "gltf": ".glb", "cloud": ".ply"}


@pytest.fixture(autouse=True)
def _no_compilation_cache(monkeypatch):
    monkeypatch.setenv("L2DGS_JAX_CACHE", "off")


@pytest.fixture
def run_folder(tmp_path_factory):
    return finished_run.folder(tmp_path_factory.getbasetemp())


@pytest.fixture
def baked_times(monkeypatch):
    """The instants that are baked. Baking, which has its own tests, is replaced: three Gaussians, one invisible."""
    times = []

    def bake(run, instants, brightest, images=("welllit",)):
        assert brightest >= 1
        for time in instants:
            times.append(time)
            means = np.full((3, 3), time, np.float32)
            quats = np.tile(np.array([[1, 0, 0, 0]], np.float32), (3, 1))
            opacities = np.array([0.5, 0.001, 1], np.float32)
            yield (Splats(means, quats, means + 1, opacities, 0 * means + np.float32(0.25)),) * len(images)

    monkeypatch.setattr(export, "bake", bake)
    for module in (export, web_page):
        monkeypatch.setattr(module, "closeness", lambda run, splats, time, image="welllit": 30 + time)
    return times


def run_command(run_folder, *arguments):
    command_line.run(export.main, [str(run_folder), *map(str, arguments)])


@pytest.mark.parametrize("format", SUFFIXES)
def test_one_instant_goes_to_one_file(run_folder, baked_times, tmp_path, capsys, format):
    path = tmp_path / "made" / f"it{SUFFIXES[format]}"
    run_command(run_folder, "--to", format, "--time", 0.25, "--output", path)
    assert baked_times == [0.25]
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    output = capsys.readouterr().out
    assert f"wrote 2 visible Gaussians, of 3 in all, to {path}" in output
    assert ("30.25 dB" in output) == (format != "cloud")


def test_many_instants_go_to_numbered_files_of_a_folder(run_folder, baked_times, tmp_path, capsys):
    run_command(run_folder, "--to", "cloud", "--times", 5, "--output", tmp_path / "frames")
    assert baked_times == [0, 0.25, 0.5, 0.75, 1]
    files = sorted((tmp_path / "frames").iterdir())
    assert [file.name for file in files] == [f"frame{i:04d}.ply" for i in range(1, 6)]
    for file, time in zip(files, baked_times, strict=True):
        points, _ = clouds.read_ply(file)
        assert (points == time).all()
    assert f"wrote 5 files of 2 visible Gaussians, of 3 in all, to {tmp_path / 'frames'}" in capsys.readouterr().out


def test_files_go_to_the_folder_of_the_run_by_default(run_folder, baked_times):
    run_command(run_folder, "--to", "splat")
    run_command(run_folder, "--to", "splat", "--times", 1)
    assert baked_times == [0.5, 0]
    written = {str(p.relative_to(run_folder)) for p in (run_folder / "exports").rglob("*.splat")}
    assert written == {"exports/scene.splat", "exports/splat/frame0001.splat"}


def test_a_page_covers_all_instants(run_folder, baked_times, tmp_path, capsys):
    run_command(run_folder, "--to", "html", "--times", 3, "--output", tmp_path / "page.html")
    assert baked_times == [0, 0.5, 1]
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]
    output = capsys.readouterr().out
    assert f"wrote {tmp_path / 'page.html'}, 0.0 MB" in output
    assert "exact well-lit images: 30.25 to 30.75 dB" in output
    assert "exact low-light images: 30.25 to 30.75 dB" in output


def test_a_page_has_one_instant_for_every_frame_by_default(run_folder, baked_times, tmp_path):
    run_command(run_folder, "--to", "html", "--output", tmp_path / "page.html")
    assert len(baked_times) == finished_run.FRAMES


def test_frames_of_several_cameras_at_one_instant_count_once_in_a_page(run_folder, baked_times, tmp_path, monkeypatch):
    run = open_run(run_folder)
    test = dataclasses.replace(run.dataset.test, cameras=jax.tree.map(lambda x: x[[1, 4]], run.dataset.train.cameras))
    both = dataclasses.replace(run, dataset=dataclasses.replace(run.dataset, test=test))
    monkeypatch.setattr(export, "open_run", lambda *_: both)
    run_command(run_folder, "--to", "html", "--output", tmp_path / "page.html")
    assert len(baked_times) == len(run.dataset.train.names)


def test_a_page_without_visible_gaussians_is_not_written(run_folder, baked_times, tmp_path, monkeypatch, capsys):
    fake = export.bake
    invisible = lambda splats: splats._replace(opacities=0 * splats.opacities)
    monkeypatch.setattr(export, "bake", lambda *arguments: (tuple(map(invisible, pair)) for pair in fake(*arguments)))
    with pytest.raises(SystemExit):
        run_command(run_folder, "--to", "html", "--times", 2, "--output", tmp_path / "page.html")
    assert "nothing is visible; expected a trained scene" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_sequence_that_fails_leaves_no_files(run_folder, baked_times, tmp_path, monkeypatch, capsys):
    fake = export.bake

    def faint(run, times, brightest):
        for (splats,), time in zip(fake(run, times, brightest), times, strict=True):
            yield (splats._replace(opacities=splats.opacities * (time < 0.6)),)

    monkeypatch.setattr(export, "bake", faint)
    with pytest.raises(SystemExit):
        run_command(run_folder, "--to", "gltf", "--times", 3, "--output", tmp_path / "frames")
    assert "nothing is visible at time 1.0; expected a trained scene" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_cameras_and_the_model_are_exported(run_folder, tmp_path, capsys):
    run = finished_run.opened(run_folder.parent)
    run_command(run_folder, "--to", "cameras", "--split", "test", "--fps", 4, "--output", tmp_path / "path.json")
    path = json.loads((tmp_path / "path.json").read_text())
    assert len(path["camera_path"]) == len(run.dataset.test.names)
    assert path["seconds"] == len(run.dataset.test.names) / 4
    run_command(run_folder, "--to", "npz", "--output", tmp_path / "scene.npz", "--stage", "coarse")
    with np.load(tmp_path / "scene.npz", allow_pickle=False) as model:
        assert not model["moving"]
        assert len(model["gaussians/means"]) == int(run.state.scene.alive.sum())
    assert f"to {tmp_path / 'scene.npz'}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "ply", "--time", "1.5"], "--time 1.5: expected an instant from 0"),
        (["--to", "ply", "--time", "nan"], "--time nan: expected an instant from 0"),
        (["--to", "ply", "--times", "0"], "--times 0: expected a whole number from 1"),
        (["--to", "ply", "--times", "3", "--time", "0"], "--times 3: given beside --time 0.0; expected one of the two"),
        (
            ["--to", "npz", "--time", "0.5"],
            "--time 0.5: npz covers all instants; expected it with one of ply, splat, gltf, cloud",
        ),
        (["--to", "cameras", "--times", "2"], "--times 2: cameras covers all instants"),
        (["--to", "html", "--time", "0"], "--time 0.0: html covers all instants; expected it with one of ply, splat"),
        (["--to", "html", "--times", "1"], "--times 1: html interpolates between instants; expected at least 2"),
        (["--to", "html", "--times", "3", "--output", "x"], "--output x: expected a file name that ends in .html"),
        (["--to", "cameras", "--fps", "0"], "--fps 0: expected a whole number from 1"),
        (["--to", "gltf", "--output", "x.ply"], "--output x.ply: expected a file name that ends in .glb"),
        (["--to", "ply", "--times", "2", "--output", "{full}"], "exists already; expected a new or an empty folder"),
        (["--to", "ply", "--output", "{full}/note.txt/x.ply"], "expected a writable folder"),
    ],
)
def test_invalid_input_gives_one_sentence_and_exit_2(run_folder, baked_times, tmp_path, capsys, arguments, message):
    (tmp_path / "note.txt").write_text("")
    with pytest.raises(SystemExit) as caught:
        run_command(run_folder, *(argument.format(full=tmp_path) for argument in arguments))
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert len([line for line in error.splitlines() if line.startswith("error: ")]) == 1
    assert not baked_times
    assert [p.name for p in tmp_path.iterdir()] == ["note.txt"]


@pytest.mark.parametrize(("format", "name"), [("npz", "checkpoint.npz"), ("cameras", "config.json")])
def test_files_that_the_run_needs_are_not_replaced(run_folder, capsys, format, name):
    file = run_folder / name
    before = file.read_bytes()
    with pytest.raises(SystemExit):
        run_command(run_folder, "--to", format, "--output", file)
    assert f"--output {file}: a file of the run itself; expected another one" in capsys.readouterr().err
    assert file.read_bytes() == before


@pytest.mark.slow
def test_a_separate_process_bakes_and_exports(run_folder, tmp_path):
    """In that process, floats have single precision."""
    command = [sys.executable, "-m", "l2dgs_jax.export", str(run_folder), "--to", "ply", "--times", "2"]
    done = subprocess.run([*command, "--output", str(tmp_path / "ply")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "PSNR of their images against the exact well-lit images" in done.stdout
    assert sorted(p.name for p in (tmp_path / "ply").iterdir()) == ["frame0001.ply", "frame0002.ply"]
