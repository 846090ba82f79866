"""Camera paths for nerfstudio, checked against its definitions."""

import json

import numpy as np
from scipy.spatial.transform import Rotation

from l2dgs_jax.exporters.camera_path import camera_path
from l2dgs_jax.types import Camera

WIDTH, HEIGHT = 64, 48


def test_points_project_to_the_same_pixels_by_nerfstudios_definitions():
    rng = np.random.default_rng(0)
    viewmat = np.tile(np.eye(4), (5, 1, 1))
    viewmat[:, :3, :3] = Rotation.random(5, rng).as_matrix()
    viewmat[:, :3, 3] = rng.normal(size=(5, 3))
    K = np.tile(np.array([[70.0, 0, WIDTH / 2], [0, 70, HEIGHT / 2], [0, 0, 1]]), (5, 1, 1))
    K[:, [0, 1], [0, 1]] *= np.arange(1, 6)[:, None]
    times = np.array([0.5, 0.0, 1.0, 0.25, 0.75])
    path = camera_path(Camera(*(x.astype(np.float32) for x in (viewmat, K, times))), WIDTH, HEIGHT, 10)

    path = json.loads(json.dumps(path))
    assert (path["render_width"], path["render_height"], path["fps"], path["seconds"]) == (WIDTH, HEIGHT, 10, 0.5)
    assert path["camera_type"] == "perspective"
    frames = path["camera_path"]
    assert [frame["render_time"] for frame in frames] == sorted(times)
    for frame, i in zip(frames, np.argsort(times), strict=True):
        point = np.linalg.inv(viewmat[i]) @ [0.3, -0.2, 2.0, 1]  # in front of the camera, above and to the right
        expected = K[i] @ [0.15, -0.1, 1]
        x, y, z, _ = np.linalg.inv(np.reshape(frame["camera_to_world"], (4, 4))) @ point
        assert z < 0  # right, up, back
        focal = HEIGHT / 2 / np.tan(np.radians(frame["fov"]) / 2)
        seen = [WIDTH / 2 + focal * x / -z, HEIGHT / 2 - focal * y / -z]
        np.testing.assert_allclose(seen, expected[:2], atol=1e-3)
