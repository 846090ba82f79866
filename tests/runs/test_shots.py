"""Shots: the views of a run that are to be rendered."""

import json

import finished_run
import numpy as np
import pytest

from l2dgs_jax.cameras.paths import interpolate
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs import shots

TIMES = np.linspace(0.25, 1, 4)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return finished_run.opened(tmp_path_factory.getbasetemp())


def test_the_shot_of_a_split_has_its_names_and_cameras(run):
    shot = shots.of_split(run, "test")
    assert (shot.title, shot.names) == ("test", run.dataset.test.names)
    assert shot.cameras is run.dataset.test.cameras
    with pytest.raises(UserError, match="has no test views"):
        shots.of_split(finished_run.without_truth_and_test(run), "test")


@pytest.mark.parametrize("flight", shots.FLIGHTS)
def test_a_flight_has_a_camera_for_every_instant(run, flight):
    shot = shots.of_flight(run, flight, TIMES, 0.5)
    assert shot.title == flight
    assert shot.names == ("000000", "000001", "000002", "000003")
    assert shot.size == (run.dataset.width, run.dataset.height)
    assert all(len(x) == 4 and x.dtype == np.float32 for x in shot.cameras)
    np.testing.assert_allclose(shot.cameras.time, [0.5] * 4 if flight == "freeze-time" else TIMES)
    moves = np.ptp(shot.cameras.viewmat, axis=0).max()
    assert moves == 0 if flight == "freeze-camera" else moves > 0.05


def test_frozen_cameras_and_times_lie_on_the_path_of_the_trained_views(run):
    trained = run.dataset.train.cameras
    frozen = shots.of_flight(run, "freeze-camera", TIMES, 0.3).cameras
    np.testing.assert_allclose(frozen.viewmat[2], interpolate(trained, np.array([0.3])).viewmat[0])
    frozen = shots.of_flight(run, "freeze-time", TIMES, 0.3).cameras
    np.testing.assert_allclose(frozen.viewmat, interpolate(trained, TIMES).viewmat)


def test_a_camera_path_file_has_its_own_size_and_frame_rate(run, tmp_path):
    pose = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1]
    content = {"camera_path": [{"camera_to_world": pose, "fov": 90}] * 2, "render_width": 80, "render_height": 60}
    (tmp_path / "tour.json").write_text(json.dumps(content | {"fps": 12.5}))
    shot = shots.of_file(run, tmp_path / "tour.json")
    assert (shot.title, shot.size, shot.fps) == ("tour", (80, 60), 12.5)
    np.testing.assert_allclose(shot.cameras.K[0, 1, 1], 30, rtol=1e-6)
    (tmp_path / "plain.json").write_text(json.dumps(content))
    assert shots.of_file(run, tmp_path / "plain.json").fps == shots.DEFAULT_FPS
    half = shot.resized((40, 30))
    assert half.size == (40, 30)
    np.testing.assert_allclose(half.cameras.K[0], [[15, 0, 20], [0, 15, 15], [0, 0, 1]], rtol=1e-6)
