"""Relocation, births and noise (MCMC): the image hardly changes, counts are met, only faint Gaussians are moved."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_training import batch_of, make_dataset, tiny

from l2dgs_jax.rasterizer import rasterize
from l2dgs_jax.training import engine, initial_state
from l2dgs_jax.training.relocation import disturb, population, relocate
from l2dgs_jax.training.step import densify, train_step
from l2dgs_jax.types import Gaussians

WIDTH, HEIGHT = 40, 32
DEAD = 0.005


def gaussians(opacities, key=0):
    count = len(opacities)
    rng = np.random.default_rng(key)
    opacities = np.asarray(opacities)
    return Gaussians(
        means=jnp.asarray(rng.uniform([-1, -0.8, 2], [1, 0.8, 3], (count, 3))),
        quats=jnp.asarray(rng.normal(size=(count, 4))),
        log_scales=jnp.asarray(np.log(rng.uniform(0.05, 0.3, (count, 3)))),
        logit_opacities=jnp.asarray(np.log(opacities / (1 - opacities))),
        illumination_dc=jnp.asarray(rng.normal(size=(count, 1))),
        illumination_rest=jnp.asarray(rng.normal(size=(count, 3))),
        reflectance=jnp.asarray(rng.uniform(0, 1, (count, 3))),
        attenuation=jnp.asarray(rng.normal(size=(count, 2))),
    )


def draw(rows, alive):
    opacities = jnp.where(alive, jax.nn.sigmoid(rows.logit_opacities), 0)
    K = jnp.array([[30.0, 0, WIDTH / 2], [0, 30.0, HEIGHT / 2], [0, 0, 1]])
    geometry = (rows.means, rows.quats, jnp.exp(rows.log_scales), opacities)
    return rasterize(*geometry, rows.reflectance, jnp.eye(4), K, WIDTH, HEIGHT)


@pytest.mark.parametrize("count", [41, 60, 90])
def test_births_hardly_change_the_image(count):
    rows = gaussians(np.tile(np.linspace(0.1, 0.95, 10), 9))
    alive = jnp.arange(90) < 40
    result = relocate(rows, alive, jnp.array(count), jax.random.key(1), DEAD)
    assert result.alive.sum() == count
    before, after = draw(rows, alive), draw(result.gaussians, result.alive)
    assert float(before.alpha.mean()) > 0.3
    assert float(jnp.abs(after.alpha - before.alpha).mean()) < 0.02
    assert float(jnp.abs(after.features - before.features).mean()) < 0.02
    naive = jax.tree.map(lambda x: x.at[40:count].set(x[: count - 40]), rows)
    assert float(jnp.abs(draw(naive, result.alive).alpha - before.alpha).mean()) > 3 * float(
        jnp.abs(after.alpha - before.alpha).mean()
    )


@pytest.mark.parametrize("copies", [1, 2, 5, 30])
@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9, 0.999])
def test_copies_have_the_joint_opacity_and_integral_of_their_source(opacity, copies):
    rows = gaussians([opacity] + [0.5] * copies)
    result = relocate(rows, jnp.arange(copies + 1) < 1, jnp.array(copies + 1), jax.random.key(0), DEAD)
    for before, after in zip(jax.tree.leaves(rows), jax.tree.leaves(result.gaussians), strict=True):
        if before is not rows.logit_opacities and before is not rows.log_scales:
            np.testing.assert_array_equal(after, np.broadcast_to(before[:1], after.shape))
    new = jax.nn.sigmoid(result.gaussians.logit_opacities)
    np.testing.assert_allclose(1 - np.prod(1 - new), opacity, rtol=1e-9)
    shrunk = np.exp(result.gaussians.log_scales[:, 0] - rows.log_scales[0, 0])
    x = np.linspace(-12, 12, 20001)
    profile = 1 - np.prod([1 - o * np.exp(-0.5 * (x / s) ** 2) for o, s in zip(new, shrunk, strict=True)], axis=0)
    np.testing.assert_allclose(profile.sum(), (opacity * np.exp(-0.5 * x**2)).sum(), rtol=1e-6)


@pytest.mark.parametrize("copies", [1, 3])
def test_spread_copies_keep_centroid_and_covariance(copies):
    count, spread = 2000, 0.6
    rows = jax.tree.map(lambda x: jnp.tile(x[:1], (count * (copies + 1), *[1] * (x.ndim - 1))), gaussians([0.3]))
    alive = jnp.arange(len(rows.means)) < 1
    whole = relocate(rows, alive, jnp.array(copies + 1), jax.random.key(0), DEAD).gaussians

    @jax.vmap
    def spread_out(key):
        few = jax.tree.map(lambda x: x[: copies + 1], rows)
        return relocate(few, alive[: copies + 1], jnp.array(copies + 1), key, DEAD, spread).gaussians

    copies_found = spread_out(jax.random.split(jax.random.key(1), count))
    np.testing.assert_allclose(copies_found.means.mean(1), np.tile(rows.means[:1], (count, 1)), atol=1e-12)
    own = np.exp(np.asarray(copies_found.log_scales[0, 0]))
    size = np.exp(np.asarray(whole.log_scales[0]))
    np.testing.assert_allclose(own, size * np.sqrt(1 - spread**2), rtol=1e-9)
    turn = Rotation.from_quat(rows.quats[0], scalar_first=True).as_matrix()
    offsets = (np.asarray(copies_found.means) - np.asarray(rows.means[0])) @ turn
    together = np.cov(offsets.reshape(-1, 3).T) + np.diag(own**2)
    np.testing.assert_allclose(together, np.diag(size**2), atol=0.05 * size.max() ** 2)


def test_spread_births_hardly_change_the_image():
    rows = gaussians(np.tile(np.linspace(0.1, 0.95, 10), 9))
    alive = jnp.arange(90) < 40
    before = draw(rows, alive)
    changes = []
    for spread in (0.5, 0.9):
        result = relocate(rows, alive, jnp.array(60), jax.random.key(1), DEAD, spread)
        unchanged = ~np.asarray(result.changed)
        for old, new in zip(jax.tree.leaves(rows), jax.tree.leaves(result.gaussians), strict=True):
            np.testing.assert_array_equal(new[unchanged], old[unchanged])
        changes.append(float(jnp.abs(draw(result.gaussians, result.alive).alpha - before.alpha).mean()))
    assert changes[0] < 0.03
    assert changes[0] < changes[1]


def test_dead_gaussians_are_relocated_to_living_ones_and_the_others_stay():
    rows = gaussians([0.4, 0.001, 0.9, 0.002, 0.6])
    alive = jnp.array([True, True, True, True, False])
    result = relocate(rows, alive, jnp.array(4), jax.random.key(3), DEAD)
    np.testing.assert_array_equal(result.alive, alive)
    living = {tuple(np.asarray(rows.means[i])) for i in (0, 2)}
    assert all(tuple(np.asarray(result.gaussians.means[i])) in living for i in (1, 3))
    np.testing.assert_array_equal(result.changed[jnp.array([1, 3, 4])], [True, True, False])
    for i in (0, 2, 4):
        if not result.changed[i]:
            for before, after in zip(jax.tree.leaves(rows), jax.tree.leaves(result.gaussians), strict=True):
                np.testing.assert_array_equal(after[i], before[i])


def test_sources_are_drawn_in_proportion_to_their_opacity():
    opacities = np.array([0.1, 0.2, 0.4, 0.8])
    rows = gaussians(np.append(opacities, np.full(4000, 0.5)))
    result = relocate(rows, jnp.arange(4004) < 4, jnp.array(4004), jax.random.key(0), DEAD)
    means = np.asarray(result.gaussians.means)
    drawn = [np.all(means[4:] == mean[None], axis=1).mean() for mean in means[:4]]
    np.testing.assert_allclose(drawn, opacities / opacities.sum(), atol=0.03)


def test_sources_are_drawn_by_need_or_by_opacity_if_no_need_is_positive():
    opacities = np.array([0.2, 0.2, 0.8])
    rows = gaussians(np.append(opacities, np.full(4000, 0.5)))
    alive = jnp.arange(4003) < 3
    for need, chances in (([1e-5, 3e-5, 0.0], [1, 3, 0]), ([0.0, 0.0, 0.0], opacities)):
        needs = jnp.asarray(np.append(need, np.full(4000, 7.0)))
        result = relocate(rows, alive, jnp.array(4003), jax.random.key(0), DEAD, 0.0, needs)
        means = np.asarray(result.gaussians.means)
        drawn = [np.all(means[3:] == mean[None], axis=1).mean() for mean in means[:3]]
        np.testing.assert_allclose(drawn, np.array(chances) / np.sum(chances), atol=0.03)


def test_without_living_gaussians_none_are_born():
    rows = gaussians([0.001, 0.002, 0.5])
    result = relocate(rows, jnp.array([True, True, False]), jnp.array(3), jax.random.key(0), DEAD)
    assert not result.changed.any()
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(result.gaussians))


def test_the_count_grows_by_equal_factors_up_to_the_limit():
    counts = [100]
    for left in (4, 3, 2, 1):
        counts.append(int(population(jnp.array(counts[-1]), 1600, left)))
    np.testing.assert_allclose(counts, [100, 200, 400, 800, 1600], atol=1)
    assert int(population(jnp.array(1700), 1600, 3)) == 1700


def test_noise_moves_only_faint_gaussians_according_to_their_covariance():
    count = 20_000
    rows = gaussians(np.full(count, 1e-6))
    rows = rows._replace(
        quats=jnp.tile(rows.quats[:1], (count, 1)), log_scales=jnp.tile(rows.log_scales[:1], (count, 1))
    )
    alive = jnp.arange(count) < count - 5
    moved = disturb(rows, alive, jnp.array(0.7), jax.random.key(0), DEAD)
    for name, before, after in zip(rows._fields, rows, moved, strict=True):
        if before is None:
            continue
        np.testing.assert_array_equal(after[-5:], before[-5:])
        if name != "means":
            np.testing.assert_array_equal(after, before)
    steps = np.asarray(moved.means - rows.means)[:-5]
    turn = Rotation.from_quat(rows.quats[0], scalar_first=True).as_matrix()
    covariance = turn @ np.diag(np.exp(2 * np.asarray(rows.log_scales[0]))) @ turn.T
    gate = 1 / (1 + np.exp(-100 * DEAD))
    expected = (0.7 * gate) ** 2 * covariance @ covariance
    np.testing.assert_allclose(np.cov(steps.T), expected, atol=0.05 * expected.max())
    solid = rows._replace(logit_opacities=jnp.full(count, 0.0))
    moved_solid = disturb(solid, alive, jnp.array(0.7), jax.random.key(0), DEAD)
    assert float(jnp.abs(moved_solid.means - rows.means).max()) < 1e-12


def growing(**changes):
    config = tiny(coarse_steps=8, fine_steps=0)
    density = dataclasses.replace(
        config.density, method="mcmc", start=0, stop=1000, interval=2, max_gaussians=64, **changes
    )
    return dataclasses.replace(config, density=density)


@pytest.mark.slow
def test_training_reaches_the_limit_and_compiles_once():
    dataset, config = make_dataset(), growing()
    state = initial_state(dataset, config)
    assert len(state.scene.alive) == 64
    engine._densify_all.clear_cache()
    counts = []
    member = engine.Member(dataset.train, config, state)
    for progress in engine.run([member]):
        counts.append(int(progress.states.scene.alive.sum()))
    assert (counts[0], counts[-1]) == (25, 64)
    assert counts == sorted(counts)
    assert len(set(counts)) == 4  # 25 and three times more: none follows the last step
    assert engine._densify_all._cache_size() == 1


def test_births_in_training_use_the_spread_of_the_settings():
    dataset = make_dataset()
    for spread in (0.0, 0.5):
        config = growing(spread=spread, noise=0.0)
        state = initial_state(dataset, config)
        grown, _ = jax.jit(densify, static_argnums=1)(state, config, 1)
        means = np.asarray(grown.scene.params.gaussians.means)[np.asarray(grown.scene.alive)]
        assert (len(means), len(np.unique(means, axis=0))) == (64, 64 if spread else 25)


def test_births_in_training_can_be_drawn_by_gradient():
    dataset, config = make_dataset(), growing(drawn_by="gradient")
    state = initial_state(dataset, config)
    one_gradient = state.stats._replace(gradient=state.stats.gradient.at[3].set(1e-4))
    grown, _ = jax.jit(densify, static_argnums=1)(state._replace(stats=one_gradient), config, 1)
    colors, source = np.asarray(grown.scene.params.gaussians.reflectance), state.scene.params.gaussians.reflectance[3]
    assert (colors == np.asarray(source)[None]).all(-1).sum() == 64 - 25 + 1


def test_noise_in_training_is_proportional_to_its_strength_and_the_learning_rate():
    dataset, config = make_dataset(), growing()
    faint = dataclasses.replace(config, model=dataclasses.replace(config.model, initial_opacity=0.004))
    state = initial_state(dataset, faint)
    batch = batch_of(dataset.train, [0, 3])

    @jax.jit
    def centres(noise, schedule):
        own = dataclasses.replace(faint, density=dataclasses.replace(faint.density, noise=noise))
        schedules = state.adam.schedules | {"means": schedule}
        begun = state._replace(adam=state.adam._replace(schedules=schedules))
        return train_step(begun, batch, own, moving=False, pair_capacity=4096)[0].scene.params.gaussians.means

    rate = state.adam.schedules["means"]
    slow = rate._replace(start=rate.start / 4, end=rate.end / 4)
    moved = lambda noise, schedule: np.abs(np.asarray(centres(noise, schedule) - centres(0.0, schedule)))
    whole = moved(1e5, rate)
    assert np.median(whole[:25]) > 1e-4
    np.testing.assert_array_equal(whole[25:], 0)
    np.testing.assert_allclose(moved(2e5, rate), 2 * whole, atol=1e-9)
    np.testing.assert_allclose(moved(1e5, slow), whole / 4, atol=1e-9)
