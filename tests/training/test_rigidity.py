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


def pairs(means, opacities):
    """Every Gaussian with its nearest ones, and the weight of the pair."""
    for i in range(N):
        distances = np.linalg.norm(means[0, i] - means[0], axis=-1)
        for j in np.argsort(distances)[1 : NEIGHBOURS + 1]:
            opacity = np.sqrt(np.prod(opacities[:, i]) * np.prod(opacities[:, j]))
            yield i, j, opacity * np.exp(-((distances[j] / RADIUS) ** 2))


def expected(means, opacities):
    """One pair at a time."""
    total = weights = 0.0
    for i, j, weight in pairs(means, opacities):
        first, second = np.linalg.norm(means[:, i] - means[:, j], axis=-1)
        total, weights = total + weight * abs(second - first), weights + weight
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
    """With neighbours and weights held constant: numerically for the second instant, by formula for both."""
    means, opacities = jax.tree.map(jnp.asarray, cloud())
    second = jax.jit(lambda second: change_of_distances(jnp.stack([means[0], second]), opacities))
    check_grads(second, (means[1],), order=1, modes=("rev",), eps=1e-6, atol=1e-7, rtol=1e-5)

    slopes = np.zeros((2, N, 3))
    for i, j, weight in pairs(*cloud()):
        offsets = means[:, i] - means[:, j]
        distances = jnp.linalg.norm(offsets, axis=-1, keepdims=True)
        sign = jnp.sign(distances[1] - distances[0])
        by_distance = weight * jnp.stack([-sign, sign]) * offsets / distances
        slopes[:, i] += by_distance
        slopes[:, j] -= by_distance
    slopes /= sum(weight for _, _, weight in pairs(*cloud())) + 1
    np.testing.assert_allclose(jax.grad(change_of_distances)(means, opacities), slopes, rtol=1e-3, atol=1e-5)


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


def with_gaussians(scene, **fields):
    return scene._replace(params=scene.params._replace(gaussians=scene.params.gaussians._replace(**fields)))


@pytest.fixture
def calls(monkeypatch):
    """What was deformed and what came out, call by call."""
    calls, deform = [], module.deform

    def spy(drawn, cameras, cfg, **options):
        calls.append((drawn, cameras, cfg, deform(drawn, cameras, cfg, **options)))
        return calls[-1][-1]

    monkeypatch.setattr(module, "deform", spy)
    return calls


def test_moving_gaussians_are_drawn_and_compared_at_two_near_instants(scene_and_config, calls, monkeypatch):
    scene, config = scene_and_config
    monkeypatch.setattr(module, "DRAWN", int(scene.alive.sum()) // 3)
    gaps = []
    for seed in range(12):
        value = rigidity(scene, config, jax.random.key(seed))
        drawn, cameras, _, moved = calls[-1]
        np.testing.assert_allclose(value, change(moved.means / scene.extent, moved.opacities), rtol=1e-9)
        assert value > 0
        assert np.all(drawn.params.gaussians.gate > 0)
        first, second = map(float, cameras.time)
        assert 0 <= first < second <= 1
        gaps.append(second - first)
    assert 0.02 <= min(gaps) < 0.05 < 0.07 < max(gaps) <= 0.1


def test_gaussians_on_paths_are_drawn_as_if_their_gates_were_open_while_they_live(scene_and_config, calls, monkeypatch):
    scene, config = scene_and_config
    number = jnp.arange(len(scene.alive))
    on_path = scene.alive & (number % 2 == 0)  # these have closed gates
    lifetime = jnp.where((number % 4 == 0)[:, None], jnp.array([0.0, 0.5]), jnp.array([0.5, 1.0]))
    lifetimes = jnp.where(on_path[:, None], lifetime, jnp.array([-jnp.inf, jnp.inf]))
    paths = jnp.asarray(np.random.default_rng(0).normal(0, 1, (5, 4, 3)))
    params = with_gaussians(scene, lifetimes=lifetimes).params._replace(paths=paths)
    tracked = scene._replace(params=params, path_of=7 * number % 5)
    means = np.asarray(scene.params.gaussians.means)
    monkeypatch.setattr(module, "DRAWN", int(scene.alive.sum()) // 3)
    shares = []
    for seed in range(12):
        rigidity(tracked, config, jax.random.key(seed))
        drawn, cameras, *_ = calls[-1]
        rows = [int(np.flatnonzero((means == mean).all(-1))[0]) for mean in np.asarray(drawn.params.gaussians.means)]
        np.testing.assert_array_equal(drawn.path_of, tracked.path_of[np.array(rows)])
        born, dies = drawn.params.gaussians.lifetimes.T
        if not cameras.time[0] < 0.5 < cameras.time[1]:
            assert np.all(born <= cameras.time[0])
            assert np.all(cameras.time[1] <= dies)
        shares.append(np.isfinite(born).mean())
    assert 0.15 < np.mean(shares) < 0.6


def test_who_is_invisible_is_nobodys_neighbour():
    """Hidden Gaussians in the same places change nothing."""
    means, opacities = cloud()
    twice = np.concatenate([means, means], 1), np.concatenate([opacities, 0 * opacities], 1)
    np.testing.assert_allclose(change(*twice), change(means, opacities), rtol=1e-9)


@pytest.mark.parametrize("factor", [1 / 1024, 1024])
def test_a_larger_scene_costs_the_same(scene_and_config, factor):
    scene, config = scene_and_config
    config = dataclasses.replace(config, unit="depth")
    larger = with_gaussians(scene, means=factor * scene.params.gaussians.means)
    larger = larger._replace(bounds=factor * scene.bounds, extent=factor * scene.extent)
    expected = rigidity(scene, config, jax.random.key(0))
    np.testing.assert_allclose(rigidity(larger, config, jax.random.key(0)), expected, rtol=1e-6)


def test_closed_gates_and_dead_rows_cost_nothing(scene_and_config):
    scene, config = scene_and_config
    cost = lambda scene: rigidity(scene, config, jax.random.key(0))
    gates = scene.params.gaussians.gate
    assert cost(scene) > 1e-4
    assert cost(with_gaussians(scene, gate=None)) > 1e-4
    assert cost(with_gaussians(scene, gate=jnp.full_like(gates, -1e3))) < 1e-12
    assert cost(scene._replace(alive=jnp.zeros_like(scene.alive))) == 0
    dead = jnp.where(scene.alive[:, None], scene.params.gaussians.means, jnp.nan)
    np.testing.assert_allclose(cost(with_gaussians(scene, means=dead)), cost(scene), rtol=1e-9)


@pytest.mark.parametrize("rows", [1, 5])
def test_few_gaussians_give_finite_values(scene_and_config, rows):
    scene, config = scene_and_config
    few = jax.tree.map(lambda x: x[:rows], scene.params.gaussians)
    few = scene._replace(params=scene.params._replace(gaussians=few), alive=scene.alive[:rows])
    value, slopes = jax.value_and_grad(
        lambda params: rigidity(few._replace(params=params), config, jax.random.key(0)), allow_int=True
    )(few.params)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((value, slopes)))


def test_gradients_reach_the_motion_field_and_not_the_look(scene_and_config):
    scene, config = scene_and_config
    slopes = jax.grad(lambda params: rigidity(scene._replace(params=params), config, jax.random.key(0)))(scene.params)
    size = lambda tree: max(float(jnp.abs(x).max()) for x in jax.tree.leaves(tree))
    for moves in (slopes.heads, slopes.hexplane, slopes.gaussians.means, slopes.gaussians.gate):
        assert size(moves) > 0
    for looks in (slopes.gaussians.reflectance, slopes.gaussians.logit_opacities, slopes.gaussians.log_scales):
        assert size(looks) == 0
