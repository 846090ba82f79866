import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.model import spherical_harmonics as sh


def unit_vectors(count, seed=0):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return jnp.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def test_the_basis_matches_the_polynomials_of_3dgs():
    directions = unit_vectors(50)
    x, y, z = np.asarray(directions).T
    c1, c2, c3 = np.sqrt(3 / np.pi) / 2, np.sqrt(15 / np.pi) / 2, np.sqrt(7 / np.pi) / 4
    expected = [
        np.full_like(x, 1 / np.sqrt(4 * np.pi)),
        *(-c1 * y, c1 * z, -c1 * x),
        *(c2 * x * y, -c2 * y * z, np.sqrt(5 / np.pi) / 4 * (2 * z**2 - x**2 - y**2), -c2 * x * z),
        c2 / 2 * (x**2 - y**2),
        -np.sqrt(35 / (2 * np.pi)) / 4 * y * (3 * x**2 - y**2),
        np.sqrt(105 / np.pi) / 2 * x * y * z,
        -np.sqrt(21 / (2 * np.pi)) / 4 * y * (4 * z**2 - x**2 - y**2),
        c3 * z * (2 * z**2 - 3 * x**2 - 3 * y**2),
        -np.sqrt(21 / (2 * np.pi)) / 4 * x * (4 * z**2 - x**2 - y**2),
        np.sqrt(105 / np.pi) / 4 * z * (x**2 - y**2),
        -np.sqrt(35 / (2 * np.pi)) / 4 * x * (x**2 - 3 * y**2),
    ]
    np.testing.assert_allclose(sh.basis(directions, 3), np.stack(expected, axis=-1), atol=1e-12)


def test_the_basis_is_orthonormal_over_the_sphere():
    cosines, weights = np.polynomial.legendre.leggauss(8)
    azimuths = np.arange(16) * 2 * np.pi / 16
    z, phi = (grid.ravel() for grid in np.meshgrid(cosines, azimuths, indexing="ij"))
    sine = np.sqrt(1 - z**2)
    values = np.asarray(sh.basis(jnp.asarray(np.stack([sine * np.cos(phi), sine * np.sin(phi), z], -1)), 5))
    area = np.repeat(weights, 16) * 2 * np.pi / 16
    np.testing.assert_allclose(values.T @ (area[:, None] * values), np.eye(36), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_gradients_of_the_basis(degree):
    check_grads(jax.jit(lambda d: sh.basis(d, degree)), (unit_vectors(4),), order=1, modes=("fwd", "rev"))


def test_gradients_of_directions():
    means = 2 * unit_vectors(4)
    check_grads(jax.jit(sh.directions), (means, jnp.array([0.1, 0.2, 0.3])), order=1, modes=("fwd", "rev"))


def test_a_gaussian_at_the_camera_has_finite_gradients():
    means = jnp.array([[1.0, 2.0, 3.0], [1.0, 2.0, 4.0]])
    total = lambda m: jnp.sum(sh.basis(sh.directions(m, m[0]), 3))
    assert jnp.all(sh.directions(means, means[0])[0] == 0)
    assert jnp.all(jnp.isfinite(jax.grad(total)(means)))


def test_batches_of_views_equal_single_views():
    means, centres = unit_vectors(6).reshape(2, 3, 3), unit_vectors(2, seed=1)
    together = sh.basis(sh.directions(means, centres), 2)
    alone = jnp.stack([sh.basis(sh.directions(m, c), 2) for m, c in zip(means, centres, strict=True)])
    np.testing.assert_array_equal(together, alone)


def test_a_negative_degree_is_refused():
    with pytest.raises(ValueError, match="at least 0"):
        sh.basis(unit_vectors(1), -1)
