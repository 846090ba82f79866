"""Conversion between a browser's camera and the renderer's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2dgs_jax.types import Camera
from l2dgs_jax.viewer.stage import Stage

FRAME = 64, 48
STAGE = Stage(unit=2.5, frame=FRAME)
TURN = Rotation.from_rotvec([0.3, -0.2, 0.1])
POINTS = np.random.default_rng(0).uniform([-0.4, -0.3, 1], [0.4, 0.3, 3], (20, 3))


@pytest.fixture
def filmed():
    viewmat, K = np.eye(4), np.diag([60.0, 60.0, 1.0])
    viewmat[:3, :3], viewmat[:3, 3] = TURN.as_matrix(), [0.1, 0.2, 0.3]
    K[:2, 2] = FRAME[0] / 2, FRAME[1] / 2
    return Camera(viewmat, K, np.float64(0.4))


def rotation_in_browser(pose):
    """The rotation that a browser reports for a camera that looks at a point."""
    forward = pose.look_at - pose.position
    right = np.cross(forward, pose.up)
    axes = np.stack([right / np.linalg.norm(right), -pose.up, forward / np.linalg.norm(forward)], axis=1)
    return np.roll(Rotation.from_matrix(axes).as_quat(), 1)


def projected(camera, size):
    """Where points of the world appear, as fractions of width and height."""
    x, y, z = camera.K @ (camera.viewmat[:3, :3] @ POINTS.T + camera.viewmat[:3, 3:])
    return np.stack([x / z / size[0], y / z / size[1]], axis=-1)


@pytest.mark.parametrize("window", [(640, 480), (1280, 480), (300, 480)])
@pytest.mark.parametrize("size", [FRAME, (320, 96)])
def test_a_camera_converted_there_and_back_shows_the_same_and_fills_the_window(filmed, window, size):
    pose = STAGE.pose(filmed, window)
    camera = STAGE.camera(rotation_in_browser(pose), pose.position, pose.field, window, size, 0.4)
    np.testing.assert_allclose(camera.viewmat, filmed.viewmat, atol=1e-6)
    fit = max(window[0] / FRAME[0], window[1] / FRAME[1])  # the frame is enlarged until it fills the window
    expected = (projected(filmed, FRAME) - 0.5) * fit * np.array(FRAME) / window + 0.5
    np.testing.assert_allclose(projected(camera, size), expected, atol=1e-5)


def test_the_unit_is_the_median_depth_of_the_points(filmed):
    batch = Camera(*(np.asarray(x)[None] for x in filmed))
    depths = (POINTS @ filmed.viewmat[2, :3]) + filmed.viewmat[2, 3]
    assert Stage.of(batch, POINTS, FRAME).unit == pytest.approx(np.median(depths))
    assert Stage.of(batch, -100 * POINTS, FRAME).unit == 1  # nothing lies before the camera
