from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.rasterizer.projection import project, rotations

GOLDEN = Path(__file__).parent / "golden"
NAMES = ("means", "quats", "scales", "viewmat", "K")


@pytest.fixture(scope="module")
def scene():
    """Six Gaussians in front of a rotated camera; some lie outside the image, where the Jacobian is clamped."""
    random = np.random.default_rng(3)
    turn = np.asarray(rotations(jnp.asarray(random.normal(size=(1, 4))))[..., 0])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = turn, [0.1, -0.2, 0.3]
    local = np.concatenate(
        [random.uniform(-1, 1, (6, 2)) * np.array([[0.5]] * 4 + [[4.0]] * 2), np.full((6, 1), 2.5)], 1
    )
    K = np.array([[30.0, 0, 17], [0, 33, 11], [0, 0, 1]])
    arrays = (
        (local - viewmat[:3, 3]) @ turn,
        random.normal(size=(6, 4)),
        random.uniform(0.05, 0.4, (6, 3)),
        viewmat,
        K,
    )
    return tuple(jnp.asarray(x) for x in arrays)


view = partial(project, width=32, height=20)
outputs = jax.jit(lambda *arrays: view(*arrays)[:4])


def test_projections_match_the_golden_scene():
    golden = np.load(GOLDEN / "s2000_160x96.npz")
    arrays = [jnp.asarray(golden[f"in_{name}"], jnp.float64) for name in NAMES]
    projected = project(*arrays, int(golden["in_width"]), int(golden["in_height"]))
    seen = golden["out_visible"]
    assert seen.sum() > 1000
    assert np.all(projected.visible[seen])
    for name in ("means2d", "conics", "depths"):
        np.testing.assert_allclose(np.asarray(getattr(projected, name))[seen], golden[f"out_{name}"][seen], rtol=1e-9)


def test_covariance_is_projected_by_the_linearised_pinhole_map(scene):
    means, quats, scales, viewmat, K = (x[:4] if x.shape[0] == 6 else x for x in scene)
    projected = view(means, quats, scales, viewmat, K)

    def pinhole(mean):
        pixel = K @ (viewmat[:3, :3] @ mean + viewmat[:3, 3])
        return pixel[:2] / pixel[2]

    turned = jnp.moveaxis(rotations(quats), -1, 0)
    covariances = turned @ (scales[:, :, None] ** 2 * jnp.swapaxes(turned, 1, 2))
    jacobians = jax.vmap(jax.jacfwd(pinhole))(means)
    expected = jacobians @ covariances @ jnp.swapaxes(jacobians, 1, 2) + 0.3 * jnp.eye(2)[None]
    np.testing.assert_allclose(projected.means2d, jax.vmap(pinhole)(means), rtol=1e-12)
    np.testing.assert_allclose(projected.covariances2d, expected[:, [0, 0, 1], [0, 1, 1]], rtol=1e-10)
    a, b, c = projected.conics.T
    conics = jnp.stack([jnp.stack([a, b], -1), jnp.stack([b, c], -1)], -1)
    np.testing.assert_allclose(conics @ expected, np.tile(np.eye(2), (4, 1, 1)), atol=1e-10)


@pytest.mark.parametrize("length", [300.0, 3_000.0, 30_000.0])
def test_long_thin_gaussians_keep_their_width_in_single_precision(length):
    """A needle in front of the camera is `length` pixels long, and a third of a pixel wide without blur."""
    half_turn = np.pi / 8  # half of 45 degrees about the line of sight
    quats = np.array([[np.cos(half_turn), 0, 0, np.sin(half_turn)]])
    arrays = ([[0.0, 0, 1]], quats, [[length / 1000, 3e-4, 3e-4]], np.eye(4), np.diag([1000.0, 1000, 1]))
    conics = {
        kind: np.asarray(view(*(jnp.asarray(x, kind) for x in arrays)).conics[0]) for kind in (jnp.float32, jnp.float64)
    }
    xx, xy, yy = conics[jnp.float64]
    across = np.linalg.eigvalsh([[xx, xy], [xy, yy]])[-1]
    assert across == pytest.approx(1 / (0.3**2 + 0.3), rel=1e-9)
    np.testing.assert_allclose(conics[jnp.float32], conics[jnp.float64], rtol=length * 1e-6)


def test_rotations_do_not_depend_on_the_norm_of_quaternions(scene):
    quats = scene[1]
    turned = jnp.moveaxis(rotations(quats), -1, 0)
    np.testing.assert_allclose(turned @ jnp.swapaxes(turned, 1, 2), np.tile(np.eye(3), (6, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(jnp.linalg.det(turned), 1, rtol=1e-12)
    np.testing.assert_allclose(rotations(-7 * quats), rotations(quats), atol=1e-12)
    quarter = rotations(jnp.array([[1.0, 0.0, 0.0, 1.0]]))[..., 0]
    np.testing.assert_allclose(quarter @ jnp.array([1.0, 0.0, 0.0]), [0, 1, 0], atol=1e-12)


def test_gradients(scene):
    check_grads(outputs, scene, order=1, modes=("rev",))


def test_extreme_inputs_give_finite_values_and_gradients(scene):
    means, quats, scales, viewmat, K = (x.astype(jnp.float32) for x in scene)
    centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
    forward = viewmat[2, :3]
    means = means.at[0].set(centre).at[1].set(centre - 3 * forward).at[2].set(centre + 0.0101 * forward)
    quats = quats.at[3].set(0)
    scales = scales.at[4].set(0).at[5].set(1e3)
    arrays = (means, quats, scales, viewmat, K)
    values = outputs(*arrays)
    gradients = jax.jit(jax.grad(lambda *a: sum(jnp.sum(x) for x in outputs(*a)), tuple(range(5))))(*arrays)
    for x in (*values, *gradients):
        assert x.dtype == jnp.float32
        assert np.all(np.isfinite(x))
    assert view(*arrays).visible.tolist() == [False, False, True, True, True, True]
    assert np.all(gradients[0][:2] == 0)
    assert np.all(gradients[1][3] == 0)
