"""`python -m l2dgs_jax.sweep`: whole studies, killed ones, several devices and processes."""

import json
import os
import signal
import socket
import subprocess
import sys
import time

import pytest
from scenes import write_nerfies

from l2dgs_jax import runs
from l2dgs_jax.study import report, running

# The order of sums depends on devices. Relative light is off, as rounding would decide which pixels clip.
STUDY = """
scenes = ["a", "b"]
preset = "default"

[settings]
coarse_steps = 6
fine_steps = 6
checkpoint_every = 2
inbetweens = 0
density = { method = "adaptive", start = 1, stop = 100, interval = 4, grad_threshold = 1e-7, max_gaussians = 80 }

[settings.model]
plane_size = 4
plane_scales = [1]
hidden = 8
sh_degree = 1
exposure = "steady"
tone = 1.5
relative_light = false

[[variants]]
name = "usual"

[[variants]]
name = "bright"
loss.exposure_level = 0.6
optim.heads_lr = 1e-4
"""
NAMES = ["00-a-seed0-usual", "01-a-seed0-bright", "02-b-seed0-usual", "03-b-seed0-bright"]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    for seed, name in enumerate("ab"):
        write_nerfies(folder / name, 10, 24, 18, num_points=30 + 5 * seed, seed=seed)
    (folder / "study.toml").write_text(STUDY)
    return folder / "study.toml"


@pytest.fixture(scope="module")
def start(study, tmp_path_factory):
    """A function that starts a sweep in a process of its own."""
    cache = str(tmp_path_factory.mktemp("cache"))

    def run(output, *arguments, devices=1, path=study):
        flags = f"--xla_force_host_platform_device_count={devices} --xla_backend_optimization_level=0"
        environment = os.environ | {"L2DGS_JAX_CACHE": cache, "PYTHONWARNINGS": "ignore", "XLA_FLAGS": flags}
        command = [sys.executable, "-m", "l2dgs_jax.sweep", str(path), str(output), *map(str, arguments)]
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    return run


def finish(*processes):
    ended = [(*process.communicate(timeout=900), process.returncode) for process in processes]
    for _, errors, code in ended:
        assert code == 0, errors
    return ended


@pytest.fixture(scope="module")
def uninterrupted(start, tmp_path_factory):
    """A study trained without interruption on one device."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    ((printed, _, _),) = finish(start(folder))
    assert "group 1 of 1: 4 members at 24x18, devices: 1" in printed
    return folder


def same_scores(expected):
    return pytest.approx(expected["scores"]["lowlight"], 1e-3, 1e-5)


def results(folder):
    return {member["name"]: member for member in json.loads((folder / report.JSON).read_text())["members"]}


def assert_same_results(folder, uninterrupted):
    found, expected = results(folder), results(uninterrupted)
    assert list(found) == list(expected) == NAMES
    for name in NAMES:
        assert found[name]["ended"] == expected[name]["ended"] == "finished"
        assert found[name]["scores"]["lowlight"] == same_scores(expected[name])
        steps = [json.loads(line)["step"] for line in (folder / name / runs.METRICS).read_text().splitlines()]
        assert steps == [10, 12]


def test_every_member_is_a_run_like_any_other(uninterrupted):
    for name in NAMES:
        run = runs.open_run(uninterrupted / name)
        assert int(run.state.step) == run.config.steps == 12
        assert run.state.scene.alive.sum() > len(run.dataset.points)
        assert (uninterrupted / name / runs.CONTACT_SHEET).stat().st_size > 1000
    assert (uninterrupted / report.PLOTS).stat().st_size > 1000
    assert (uninterrupted / report.MARKDOWN).read_text().count("finished") == 4


def kill_after_a_checkpoint(folder, *processes):
    """Kill the last of some processes once every member has a checkpoint; returns the others."""
    deadline = time.monotonic() + 600
    while not all((folder / name / runs.CHECKPOINT).exists() for name in NAMES):
        assert all(process.poll() is None for process in processes)
        assert time.monotonic() < deadline
        time.sleep(0.02)
    processes[-1].send_signal(signal.SIGKILL)
    processes[-1].communicate()
    return processes[:-1]


def test_a_killed_study_resumes_to_the_same_results(start, uninterrupted, tmp_path):
    kill_after_a_checkpoint(tmp_path / "out", start(tmp_path / "out"))
    assert not (tmp_path / "out" / report.JSON).exists()
    finish(start(tmp_path / "out", "--resume"))
    assert_same_results(tmp_path / "out", uninterrupted)


def test_four_devices_give_the_same_results(start, uninterrupted, tmp_path):
    ((printed, _, _),) = finish(start(tmp_path / "out", devices=4))
    assert "devices: 4" in printed
    assert_same_results(tmp_path / "out", uninterrupted)


def address():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


def start_two_processes(start, output, *arguments):
    coordinator = address()
    options = lambda process: ("--coordinator", coordinator, "--processes", 2, "--process", process, *arguments)
    return [start(output, *options(process)) for process in (0, 1)]


@pytest.mark.parametrize("survivor", [0, 1])
def test_two_processes_resume_after_one_is_killed(start, uninterrupted, tmp_path, survivor):
    folder = tmp_path / "out"
    processes = start_two_processes(start, folder)
    (remaining,) = kill_after_a_checkpoint(folder, processes[survivor], processes[1 - survivor])
    _, errors = remaining.communicate(timeout=120)
    assert remaining.returncode != 0
    assert "error: this training has lost one of its processes" in errors
    assert "--resume" in errors
    finish(*start_two_processes(start, folder, "--resume"))
    assert_same_results(folder, uninterrupted)


@pytest.mark.parametrize("process", [0, 1])
def test_processes_that_do_not_find_each_other_give_up(start, tmp_path, process):
    options = ("--coordinator", address(), "--processes", 2, "--process", process, "--timeout", 4)
    start_time = time.monotonic()
    _, errors = (alone := start(tmp_path / "out", *options)).communicate(timeout=120)
    assert alone.returncode == 2
    assert "did not find each other within 4 s" in errors
    assert errors.strip().splitlines()[-1].startswith("error: ")
    assert time.monotonic() - start_time < 60
    assert not (tmp_path / "out").exists()


def test_a_member_that_diverges_is_frozen_and_reported(start, uninterrupted, study, tmp_path):
    path = study.parent / "diverging.toml"
    path.write_text(STUDY + '\n[[variants]]\nname = "wild"\noptim.means_lr = 1e30\noptim.scales_lr = 1e30\n')
    finish(start(tmp_path / "out", path=path))
    found = results(tmp_path / "out")
    assert [member["ended"].split(" at ")[0] for member in found.values()] == ["finished", "finished", "diverged"] * 2
    for name, expected in results(uninterrupted).items():
        same = next(member for key, member in found.items() if key[3:] == name[3:])
        assert same["scores"]["lowlight"] == same_scores(expected)
    frozen = next(folder for folder in (tmp_path / "out").glob("*wild"))
    assert json.loads((frozen / running.DIVERGED_FILE).read_text())["step"] == int(runs.open_run(frozen).state.step)
