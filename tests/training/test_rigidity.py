import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation
from tiny_training import make_dataset, tiny, uneven

from l2dgs_jax.training import initial_state
from l2dgs_jax.training import rigidity as module
from l2dgs_jax.training.rigidity import NEIGHBOURS, RADIUS, change_of_distances, rigidity

N = 12
change = jax.jit(change_of_distances)


def cloud(seed=0):
    """Centres at two instants, within a few radii, and their opacities."""
    rng = np.random.default_rng(seed)
    first = rng.normal(0, RADIUS, (N, 3))
    return np.stack([first, first + rng.normal(0, RADIUS / 3, (N, 3))]), rng.uniform(0.1, 1, (2, N))


def expected(means, opacities):
    """One pair at a time."""
    total = weights = 0.0
    for i in range(N):
        distances = np.linalg.norm(means[:, i, None] - means, axis=-1)
        for j in np.argsort(distances[0])[1 : NEIGHBOURS + 1]:
            opacity = np.sqrt(np.prod(opacities[:, i]) * np.prod(opacities[:, j]))
            weight = opacity * np.exp(-((distances[0, j] / RADIUS) ** 2))
            total, weights = total + weight * abs(distances[1, j] - distances[0, j]), weights + weight
    return total / (weights + 1)


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_weighted_mean_change_over_pairs(seed):
    means, opacities = cloud(seed)
    np.testing.assert_allclose(change(means, opacities), expected(means, opacities), rtol=1e-4)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 1000), shift=st.floats(-10, 10))
def test_a_body_that_turns_and_moves_as_a_whole_costs_nothing(seed, shift):
    (first, _), opacities = cloud()
    turned = first @ Rotation.random(random_state=seed).as_matrix().T + shift
    assert change(np.stack([first, turned]), opacities) < 1e-12
    assert change(np.stack([first, 1.1 * turned]), opacities) > 1e-4


def test_what_is_not_visible_at_both_instants_does_not_count():
    means, opacities = cloud()
    means[1, 0] += 5
    visible = change(means, opacities)
    for instant in (0, 1):
        faded = opacities.copy()
        faded[instant, 0] = 0
        assert change(means, faded) < 0.2 * visible


def test_gradients():
    (first, second), opacities = jax.tree.map(jnp.asarray, cloud())
    function = jax.jit(lambda second: change_of_distances(jnp.stack([first, second]), opacities))
    check_grads(function, (second,), order=1, modes=("rev",), eps=1e-6, atol=1e-7, rtol=1e-5)


def test_gradients_are_finite_where_all_are_in_one_place():
    means, opacities = jnp.zeros((2, N, 3), jnp.float32), jnp.ones((2, N), jnp.float32)
    value, slopes = jax.value_and_grad(change_of_distances)(means, opacities)
    assert value == 0
    assert value.dtype == jnp.float32
    assert jnp.isfinite(slopes).all()


@pytest.fixture(scope="module")
def scene_and_config():
    """A dense scene in which all Gaussians would move, if every other one did not have a closed gate."""
    config = tiny()
    scene = initial_state(make_dataset(), config).scene
    params = uneven(scene.params)
    gates = jnp.where(jnp.arange(len(scene.alive)) % 2, 20.0, -20.0)
    gaussians = params.gaussians._replace(gate=gates, means=RADIUS * params.gaussians.means)
    return scene._replace(params=params._replace(gaussians=gaussians)), config.model


def test_it_is_that_of_moving_gaussians_at_two_near_instants(scene_and_config, monkeypatch):
    """With room for few of them, those whose gates are open are drawn."""
    scene, config = scene_and_config
    monkeypatch.setattr(module, "DRAWN", int(scene.alive.sum()) // 3)
    seen = {}

    def spy(drawn, cameras, cfg, **options):
        seen.update(gates=drawn.params.gaussians.gate, instants=cameras.time, share=cfg.moving_share)
        return deform(drawn, cameras, cfg, **options)

    deform = module.deform
    monkeypatch.setattr(module, "deform", spy)
    gaps = []
    for seed in range(12):
        value = rigidity(scene, dataclasses.replace(config, moving_share=0.5), jax.random.key(seed))
        first, second = map(float, seen["instants"])
        assert value > 0
        assert 0 <= first < second <= 1
        assert np.all(seen["gates"] > 0)
        assert seen["share"] == 1
        gaps.append(second - first)
    assert 0.02 <= min(gaps) < 0.05 < 0.07 < max(gaps) <= 0.1


def test_closed_gates_and_dead_rows_cost_nothing(scene_and_config):
    scene, config = scene_and_config
    gates = scene.params.gaussians.gate
    for still in (
        scene._replace(
            params=scene.params._replace(gaussians=scene.params.gaussians._replace(gate=jnp.full_like(gates, -1e3)))
        ),
        scene._replace(alive=jnp.zeros_like(scene.alive)),
    ):
        assert rigidity(still, config, jax.random.key(0)) < 1e-12


def test_gradients_reach_the_motion_field_and_not_the_look(scene_and_config):
    scene, config = scene_and_config
    slopes = jax.grad(lambda params: rigidity(scene._replace(params=params), config, jax.random.key(0)))(scene.params)
    size = lambda tree: max(float(jnp.abs(x).max()) for x in jax.tree.leaves(tree))
    assert size(slopes.heads) > 0
    assert size(slopes.hexplane) > 0
    assert size(slopes.gaussians.reflectance) == 0
    assert size(slopes.gaussians.logit_opacities) == 0
