"""Positions, depths and projections of cameras, and cameras of other image sizes."""

import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from l2dgs_jax.cameras import camera_centres, camera_extent, median_depth, reframe, resize, select_camera
from l2dgs_jax.cameras.geometry import mean_up, project_points
from l2dgs_jax.types import Camera


def cameras(centres):
    count = len(centres)
    viewmat = np.tile(np.eye(4), (count, 1, 1))
    viewmat[:, :3, :3] = Rotation.random(count, 0).as_matrix()
    viewmat[:, :3, 3] = -np.einsum("fij,fj->fi", viewmat[:, :3, :3], centres)
    K = np.tile(np.array([[14.0, 0.3, 8], [0, 15, 6], [0, 0, 1]]), (count, 1, 1))
    return Camera(viewmat, K, np.linspace(0, 1, count))


CENTRES = np.random.default_rng(1).normal(size=(5, 3))


def test_centres_of_cameras_in_numpy_and_jax():
    viewmats = cameras(CENTRES).viewmat
    np.testing.assert_allclose(camera_centres(viewmats), CENTRES, atol=1e-12)
    np.testing.assert_allclose(camera_centres(jnp.asarray(viewmats[2])), CENTRES[2], atol=1e-12)
    assert isinstance(camera_centres(viewmats), np.ndarray)
    check_grads(camera_centres, (jnp.asarray(viewmats),), order=1)


def test_the_extent_is_the_radius_with_a_margin():
    circle = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]]) + 7
    np.testing.assert_allclose(camera_extent(cameras(circle)), 1.1)
    assert camera_extent(cameras(circle[:1])) == 0


def test_mean_up_of_cameras_all_around_is_the_up_of_the_world():
    world = Rotation.from_rotvec([0.4, -1.1, 0.7])
    headings = Rotation.from_euler("YX", [[angle, 0.6] for angle in (0, np.pi / 2, np.pi, -np.pi / 2)])
    viewmats = np.tile(np.eye(4), (4, 1, 1))
    viewmats[:, :3, :3] = (world * headings).inv().as_matrix()
    np.testing.assert_allclose(mean_up(viewmats), world.apply([0, -1, 0]), atol=1e-12)  # y points down
    upside_down = np.diag([-1, -1, 1, 1]) @ viewmats[:1]
    np.testing.assert_allclose(np.linalg.norm(mean_up(np.concatenate([viewmats[:1], upside_down]))), 1)


@pytest.mark.parametrize("of", [lambda batch: select_camera(batch, 2), lambda batch: batch], ids=["one", "each"])
def test_points_project_to_the_pixels_of_their_rays(of):
    camera = of(cameras(CENTRES))
    pixels, depths = np.random.default_rng(2).uniform(1, 20, (5, 2)), np.array([0.5, 1, 3, 9, -2])
    rays = np.einsum("...ij,...j->...i", np.linalg.inv(camera.K), np.concatenate([pixels, np.ones((5, 1))], -1))
    axes = camera.viewmat[..., :3, :3].swapaxes(-1, -2)
    points = camera_centres(camera.viewmat) + np.einsum("...ij,...j->...i", axes, depths[:, None] * rays)
    found, depth = project_points(points, camera.viewmat, camera.K)
    np.testing.assert_allclose(depth, depths)
    np.testing.assert_allclose(found[:4], pixels[:4])
    assert np.isnan(found[4]).all()  # behind the camera


def test_a_resized_camera_sees_the_same():
    camera = select_camera(cameras(CENTRES), 3)
    point = np.array([0.2, -0.1, 3.0])
    pixel = lambda camera: (np.asarray(camera.K) @ point)[:2] / point[2]
    np.testing.assert_allclose(pixel(resize(camera, 2.5)), 2.5 * pixel(camera), rtol=1e-12)
    np.testing.assert_array_equal(resize(camera, 2).viewmat, camera.viewmat)
    batch = resize(cameras(CENTRES), 0.5).K
    np.testing.assert_allclose(batch[:, 1, 1], 7.5)
    np.testing.assert_allclose(batch[:, 2], [[0, 0, 1]] * 5)


@pytest.mark.parametrize("wanted", [(32, 24), (16, 12), (40, 12), (7, 30), (1, 1)])
def test_a_reframed_camera_sees_a_central_part_undistorted(wanted):
    camera, size = select_camera(cameras(CENTRES), 2), (16, 12)
    K = reframe(camera, size, wanted).K
    factor = max(wanted[0] / size[0], wanted[1] / size[1])
    np.testing.assert_allclose(K[:2, :2], factor * camera.K[:2, :2])
    corners = np.linalg.inv(K) @ np.array([[0, 0, 1], [*wanted, 1]]).T
    seen = (camera.K @ corners)[:2].T
    assert (seen[0] >= -1e-9).all()
    assert (seen[1] <= np.array(size) + 1e-9).all()
    np.testing.assert_allclose(seen.mean(0), np.array(size) / 2)
    assert np.isclose(seen[1] - seen[0], size).any()


def test_the_median_depth_is_that_of_the_points_in_front():
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    viewmats[:, 2, 3] = [0, 1, -3.5]
    points = np.array([[5.0, 0, 1], [0, 5, 2], [0, 0, 3], [0, 1, 4]])
    assert median_depth(Camera(viewmats, np.zeros((3, 3, 3)), np.zeros(3)), points) == 2.5
    with pytest.raises(ValueError, match="in front"):
        median_depth(Camera(viewmats, np.zeros((3, 3, 3)), np.zeros(3)), points - [0, 0, 100])
