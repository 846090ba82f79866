"""Clone, split and prune: which Gaussians, where the new ones go, and what happens when rows run out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from l2dgs_jax.config import DensityConfig
from l2dgs_jax.training.densification import GrowthStats, accumulate, densify
from l2dgs_jax.types import Gaussians

CFG = DensityConfig(grad_threshold=1.0, clone_below=0.1, prune_opacity=0.005, max_gaussians=100)


def gaussians(count, key=0):
    normal = lambda index, *shape: jax.random.normal(jax.random.fold_in(jax.random.key(key), index), (count, *shape))
    return Gaussians(
        means=normal(0, 3),
        quats=normal(1, 4),
        log_scales=jnp.full((count, 3), jnp.log(0.01)),
        logit_opacities=jnp.zeros(count),
        illumination_dc=normal(2, 1),
        illumination_rest=normal(3, 3),
        reflectance=normal(4, 3),
        attenuation=normal(5, 2),
    )


def stats(gradient, seen=None):
    gradient = jnp.array(gradient, float)
    return GrowthStats(gradient, jnp.ones_like(gradient) if seen is None else jnp.array(seen, float))


def run(rows, alive, statistics, cfg=CFG, key=7):
    return densify(rows, jnp.array(alive), statistics, jnp.array(1.0), jax.random.key(key), cfg)


def test_a_small_gaussian_with_a_large_gradient_is_cloned_exactly():
    rows = gaussians(4)
    result = run(rows, [True, True, False, False], stats([0.5, 2.0, 9.0, 9.0]))
    np.testing.assert_array_equal(result.alive, [True, True, True, False])
    np.testing.assert_array_equal(result.changed, [False, False, True, False])
    for before, after in zip(jax.tree.leaves(rows), jax.tree.leaves(result.gaussians), strict=True):
        np.testing.assert_array_equal(after[:2], before[:2])
        np.testing.assert_array_equal(after[2], before[1])
    assert result.wanted == 1
    assert result.missing == 0


def test_a_large_gaussian_with_a_large_gradient_splits_into_two_smaller_samples_of_itself():
    rows = gaussians(2)
    rows = rows._replace(log_scales=jnp.log(jnp.array([[0.5, 1e-6, 1e-6], [0.01] * 3])))
    result = run(rows, [True, False], stats([2.0, 0.0]))
    np.testing.assert_array_equal(result.alive, [True, True])
    np.testing.assert_array_equal(result.changed, [True, True])
    np.testing.assert_allclose(result.gaussians.log_scales, jnp.tile(rows.log_scales[:1] - jnp.log(1.6), (2, 1)))
    offsets = result.gaussians.means - rows.means[:1]
    w, x, y, z = rows.quats[0] / jnp.linalg.norm(rows.quats[0])
    long_axis = jnp.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    lengths = jnp.abs(offsets @ long_axis)
    assert (lengths > 1e-3).all()
    np.testing.assert_allclose(jnp.linalg.norm(offsets, axis=-1), lengths, rtol=1e-3)
    assert jnp.linalg.norm(offsets[0] - offsets[1]) > 1e-3


def test_the_centres_of_split_gaussians_have_the_covariance_of_their_source():
    count = 4000
    scales = jnp.array([0.5, 0.2, 0.3])
    rows = jax.tree.map(lambda x: jnp.tile(x[:1], (2 * count, *[1] * (x.ndim - 1))), gaussians(1))
    rows = rows._replace(means=jnp.zeros((2 * count, 3)), log_scales=jnp.tile(jnp.log(scales), (2 * count, 1)))
    alive = jnp.arange(2 * count) < count
    result = run(
        rows, alive, stats(2.0 * alive.astype(float)), DensityConfig(grad_threshold=1.0, max_gaussians=2 * count)
    )
    assert result.alive.all()
    w, x, y, z = rows.quats[0] / jnp.linalg.norm(rows.quats[0])
    rotation = jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    expected = rotation @ jnp.diag(scales**2) @ rotation.T
    np.testing.assert_allclose(jnp.cov(result.gaussians.means.T), expected, atol=0.02)


def test_transparent_gaussians_are_pruned_and_their_rows_reused():
    rows = gaussians(3)._replace(logit_opacities=jnp.array([-20.0, 0.0, 0.0]))
    result = run(rows, [True, True, True], stats([5.0, 2.0, 0.0]))
    assert result.alive.all()
    np.testing.assert_array_equal(result.changed, [True, False, False])
    np.testing.assert_array_equal(result.gaussians.means[0], rows.means[1])


def test_nothing_is_pruned_until_the_count_exceeds_prune_above():
    rows = gaussians(2)._replace(logit_opacities=jnp.array([-20.0, 0.0]))
    result = run(rows, [True, True], stats([0.0, 0.0]), DensityConfig(prune_above=2))
    np.testing.assert_array_equal(result.alive, [True, True])


def test_births_without_a_free_row_are_counted_as_missing():
    result = run(gaussians(3), [True, True, False], stats([2.0, 3.0, 0.0]))
    assert result.wanted == 2
    assert result.missing == 1
    np.testing.assert_array_equal(result.gaussians.means[2], gaussians(3).means[1])


@pytest.mark.parametrize(("limit", "born"), [(2, 0), (3, 1), (4, 2)])
def test_under_a_limit_the_largest_gradients_are_cloned_first(limit, born):
    cfg = DensityConfig(grad_threshold=1.0, clone_below=0.1, max_gaussians=limit)
    rows = gaussians(6)
    result = run(rows, [True, True, False, False, False, False], stats([2.0, 3.0, 0, 0, 0, 0]), cfg)
    assert result.missing == 0
    assert result.alive.sum() == 2 + born
    if born:
        np.testing.assert_array_equal(result.gaussians.means[2], rows.means[1])


def test_the_threshold_applies_to_the_mean_gradient_over_sightings():
    alive = [True, True, True, False, False, False]
    result = run(gaussians(6), alive, stats([3.0, 3.0, 0, 0, 0, 0], [2.0, 4.0, 0, 0, 0, 0]))
    assert result.wanted == 1


def test_accumulate_adds_gradient_norms_in_normalised_coordinates_and_counts_sightings():
    gradient = jnp.array([[3.0, 2.0], [0.0, 0.0]])
    radii = jnp.array([2.0, 0.0])
    result = accumulate(stats([1.0, 1.0], [5.0, 5.0]), gradient, radii, 2, 4)
    np.testing.assert_allclose(result.gradient, [1 + 5.0, 1 + 0.0])
    np.testing.assert_allclose(result.seen, [6.0, 5.0])


def test_with_conserve_opacity_a_pair_has_the_joint_opacity_of_its_source():
    cfg = DensityConfig(grad_threshold=1.0, clone_below=0.1, conserve_opacity=True)
    rows = gaussians(4)._replace(logit_opacities=jnp.array([-3.0, 0.0, 8.0, 0.0]))
    alive = [True, True, True, False]
    for chosen in range(3):
        result = run(rows, alive, stats(jnp.eye(4)[chosen] * 2), cfg)
        before = jax.nn.sigmoid(rows.logit_opacities)
        after = jax.nn.sigmoid(result.gaussians.logit_opacities)
        np.testing.assert_allclose(1 - (1 - after[chosen]) * (1 - after[3]), before[chosen], rtol=1e-9)
        np.testing.assert_array_equal(np.delete(after, [chosen, 3]), np.delete(before, [chosen, 3]))
        np.testing.assert_array_equal(np.flatnonzero(result.changed), [chosen, 3])
