"""Schedules and weights as a whole run applies them at each step, not only their formulas."""

import dataclasses
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_training import batch_of, make_dataset, tiny, uneven

from l2dgs_jax.config import DensityConfig, overrides
from l2dgs_jax.config.settings import RATE_GROUPS
from l2dgs_jax.model import hexplane
from l2dgs_jax.runtime import devices
from l2dgs_jax.training import engine, initial_state, losses, objective, resolve
from l2dgs_jax.training.batching import view_indices
from l2dgs_jax.training.initial_state import split_darkening
from l2dgs_jax.training.parameter_groups import groups
from l2dgs_jax.training.state import StepReport
from l2dgs_jax.training.step import cooldown, train_step

COARSE, FINE = 10, 15


@pytest.fixture(scope="module")
def dataset():
    return make_dataset()


def config_of(**changes):
    return overrides.replace(tiny(coarse_steps=COARSE, fine_steps=FINE, sh_warmup=4), changes)


def spied_objective(dataset, monkeypatch, config, moving):
    """A function of the step number: the exponent of Eq. 10, the target of B1's prior and the SH degree used there."""
    seen = {}
    render, total = objective.render, losses.total

    def spy_on_render(*arguments, **options):
        seen["sh_degree"] = options["sh_degree"]
        return render(*arguments, **options)

    def spy_on_total(output, target, cfg, eta, exponent_target, valid):
        seen.update(eta=eta, exponent_target=exponent_target)
        return total(output, target, cfg, eta, exponent_target, valid)

    monkeypatch.setattr(objective, "render", spy_on_render)
    monkeypatch.setattr(losses, "total", spy_on_total)
    state, batch = initial_state(dataset, config), batch_of(dataset.train, [0, 3])
    probe = jnp.zeros((2, len(state.scene.alive), 2))

    @jax.jit
    def evaluate(number):
        objective.objective(state.scene.params, probe, state._replace(step=number), batch, config, moving, 4096)
        return dict(seen)

    return lambda number: {name: float(value) for name, value in evaluate(jnp.int32(number)).items()}


# The exponent falls from 0.9 to 0.4 over the whole run or, if it restarts, within each stage.
@pytest.mark.parametrize(
    ("restarts", "moving", "progress"),
    [
        (False, False, {0: 0, 6: 6 / 25}),
        (False, True, {COARSE: 10 / 25, 20: 20 / 25}),
        (True, False, {0: 0, 6: 6 / 10}),
        (True, True, {COARSE: 0, 16: 6 / 15}),
    ],
)
def test_the_exponent_of_eq_10_decays_over_the_run_or_each_stage(dataset, monkeypatch, restarts, moving, progress):
    config = config_of(**{"loss.eta_start": 0.9, "loss.eta_end": 0.4, "loss.eta_restarts": restarts})
    values_at = spied_objective(dataset, monkeypatch, config, moving)
    for number, part in progress.items():
        np.testing.assert_allclose(values_at(number)["eta"], 0.9 * (0.4 / 0.9) ** part, rtol=1e-6)


@pytest.mark.parametrize(("moving", "degrees"), [(False, {0: 0, 3: 0, 4: 1, 8: 2}), (True, {11: 2, 12: 3, 24: 3})])
def test_the_sh_degree_of_the_illumination_rises_with_the_steps(dataset, monkeypatch, moving, degrees):
    config = config_of()
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, sh_degree=3))
    values_at = spied_objective(dataset, monkeypatch, config, moving)
    assert {number: values_at(number)["sh_degree"] for number in degrees} == degrees


@pytest.mark.parametrize(("exponents", "target"), [((1.7, 9.0), 1.7), (None, 1.0)])
def test_the_target_of_the_exponent_prior_is_its_initial_value(dataset, monkeypatch, exponents, target):
    config = config_of(**{"model.initial_exponents": exponents})
    assert spied_objective(dataset, monkeypatch, config, False)(0)["exponent_target"] == target


def test_of_more_points_than_there_may_be_gaussians_as_many_are_used(dataset):
    rng = np.random.default_rng(0)
    dense = dataclasses.replace(dataset, points=rng.normal(size=(900, 3)), colors=rng.random((900, 3), np.float32))
    state = initial_state(dense, config_of(**{"density.max_gaussians": 70}))
    used = np.asarray(state.scene.params.gaussians.means)[np.asarray(state.scene.alive)]
    assert len(used) == 70
    apart = np.linalg.norm(used[:, None] - dense.points, axis=-1)
    assert len(set(apart.argmin(1))) == 70
    np.testing.assert_allclose(apart.min(1), 0, atol=1e-6)
    assert (abs(used.mean(0)) < 0.3).all()


def test_the_planes_are_smoothed_in_the_fine_stage_only(dataset):
    weights = {"loss.plane_smoothness": 2.0, "loss.time_smoothness": 3.0, "loss.time_l1": 5.0}
    config, batch = config_of(**weights), batch_of(dataset.train, [0, 3])
    state = initial_state(dataset, config)
    planes = jax.tree.map(lambda x: jax.random.normal(jax.random.key(0), x.shape), state.scene.params.hexplane)
    params = state.scene.params._replace(hexplane=planes)
    probe = jnp.zeros((2, len(state.scene.alive), 2))

    @jax.jit
    def added(state):
        plain = overrides.replace(config, dict.fromkeys(weights, 0.0))
        loss = lambda config, moving: objective.objective(params, probe, state, batch, config, moving, 4096)[0]
        return [loss(config, moving) - loss(plain, moving) for moving in (False, True)]

    coarse, fine = added(state)
    assert coarse == 0
    np.testing.assert_allclose(fine, np.dot([2, 3, 5], hexplane.regularisers(planes)), rtol=1e-9)


@pytest.fixture
def journal(monkeypatch):
    """A record of what `engine.run` calls at which step; nothing is trained."""
    entries = SimpleNamespace(steps=[], stages=[], growths=[], growths_left=[])

    def train_steps(states, batches, values, number, *, config, moving, pair_capacity, mesh):
        entries.steps.append((number, moving, np.asarray(batches.cameras.time)[0].tolist()))
        report = StepReport(*[jnp.zeros(1)] * 6)
        return states._replace(step=states.step + 1), report, engine.Tally(0, 1)

    begin = engine.begin_fine_stage

    def begin_fine_stage(states, values, number, **options):
        entries.stages.append(number)
        return begin(states, values, number, **options)

    def densify_all(states, values, number, left, **_):
        entries.growths.append(number)
        entries.growths_left.append(left)
        return states

    monkeypatch.setattr(engine, "train_steps", train_steps)
    monkeypatch.setattr(engine, "begin_fine_stage", begin_fine_stage)
    monkeypatch.setattr(engine, "densify_all", densify_all)
    return entries


def run(dataset, config, state=None):
    member = engine.Member(dataset.train, config, initial_state(dataset, config) if state is None else state)
    return [(p.step, jax.tree.map(np.asarray, devices.member(p.states, 0))) for p in engine.run([member], 4096)]


def test_a_run_has_its_stages_views_and_densifications_at_the_right_steps(dataset, journal):
    density = DensityConfig(start=2, stop=9, interval=3)
    config = dataclasses.replace(config_of(seed=5), density=density)
    states = dict(run(dataset, config))
    assert [number for number, _, _ in journal.steps] == list(range(COARSE + FINE))
    assert [moving for _, moving, _ in journal.steps] == [False] * COARSE + [True] * FINE
    times = dataset.train.cameras.time
    for number, _, shown in journal.steps:
        np.testing.assert_array_equal(shown, times[view_indices(5, number, config.batch_size, len(times))])
    assert journal.stages == [COARSE]
    assert journal.growths == [3, 6, COARSE + 3, COARSE + 6]  # counted from the start of each stage
    assert journal.growths_left == [2, 1, 2, 1]
    assert states[COARSE + FINE].step == COARSE + FINE


@pytest.mark.parametrize("stage", ["coarse", "fine"])
def test_no_densification_follows_the_last_step(dataset, journal, stage):
    density = DensityConfig(start=2, stop=100, interval=3)
    steps = {"coarse_steps": 9, "fine_steps": 0} if stage == "coarse" else {"coarse_steps": 6, "fine_steps": 6}
    run(dataset, dataclasses.replace(config_of(), density=density, **steps))
    assert journal.growths == ([3, 6] if stage == "coarse" else [3, 6, 9])
    assert journal.growths_left == ([2, 1] if stage == "coarse" else [2, 1, 1])


def test_densification_that_stops_before_it_starts_never_happens(dataset, journal):
    run(dataset, dataclasses.replace(config_of(), density=DensityConfig(start=2, stop=0, interval=3)))
    assert journal.growths == []


@pytest.mark.parametrize(("decay_steps", "coarse", "fine"), [(None, COARSE, FINE), (7, 7, 7)])
def test_learning_rates_decay_over_their_stage_or_decay_steps(dataset, journal, decay_steps, coarse, fine):
    config = config_of(**{"optim.decay_steps": decay_steps})
    states = dict(run(dataset, config))
    extent = float(states[1].scene.extent)
    for number, length in ((1, coarse), (COARSE, coarse), (COARSE + 1, fine), (COARSE + FINE, fine)):
        schedules = states[number].adam.schedules
        assert {float(schedule.steps) for schedule in schedules.values()} == {length}
        np.testing.assert_allclose(schedules["means"].start, config.optim.means_lr * extent)
        np.testing.assert_allclose(schedules["bafe"].start, config.optim.bafe_lr)


@pytest.mark.parametrize(("share", "factors"), [(0.0, [1, 1, 1, 1]), (0.5, [1, 1, 0.5, 0]), (1.0, [1, 0.5, 0.25, 0])])
def test_learning_rates_fall_to_0_in_the_last_share_of_the_run(share, factors):
    config = config_of(**{"coarse_steps": 20, "fine_steps": 80, "optim.cooldown": share})
    np.testing.assert_allclose([cooldown(step, config) for step in (0, 50, 75, 100)], factors)


def test_a_step_near_the_end_is_as_much_shorter_as_its_learning_rate(dataset):
    config, batch = config_of(), batch_of(dataset.train, [0, 3])
    state = initial_state(dataset, config)._replace(step=jnp.int32(COARSE + FINE - 1))

    @jax.jit
    def movement(share):
        own = overrides.replace(config, {"optim.cooldown": share})
        after, _ = train_step(state, batch, own, moving=True, pair_capacity=4096)
        return jax.tree.map(jnp.subtract, after.scene.params, state.scene.params)

    whole, part = movement(0.0), movement(0.5)
    assert max(jnp.abs(x).max() for x in jax.tree.leaves(whole)) > 1e-4
    factor = 1 / (0.5 * (COARSE + FINE))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(y, factor * x, atol=1e-12), whole, part)


def test_adam_is_reset_at_the_fine_stage_but_not_on_resuming(dataset, journal):
    config = config_of()
    state = initial_state(dataset, config)
    used = jax.tree.map(lambda x: x + 1 if x.dtype == float else x, state.adam.mu)
    state = state._replace(adam=state.adam._replace(mu=used, step=jnp.int32(4)), step=jnp.int32(4))
    states = dict(run(dataset, config, state))
    assert min(states) == 5
    assert states[COARSE].adam.step == 4
    assert states[COARSE].adam.mu.gaussians.means.max() == 1
    assert states[COARSE + 1].adam.step == 0
    assert not any(x.any() for x in jax.tree.leaves(states[COARSE + 1].adam.mu))


@pytest.mark.slow
def test_every_rate_moves_its_parameters_and_no_others(dataset):
    # Bounds would clip the reflectances that the noise below puts outside them, whatever their rate.
    config = config_of(**{"model.motion_gate": True, "model.bounded_reflectance": False})
    state, batch = initial_state(dataset, config), batch_of(dataset.train, [0, 3])
    leaves, treedef = jax.tree.flatten(state.scene.params)
    keys = jax.random.split(jax.random.key(0), len(leaves))
    leaves = [x + 0.03 * jax.random.normal(key, x.shape) for x, key in zip(leaves, keys, strict=True)]
    params = treedef.unflatten(leaves)
    state = state._replace(scene=state.scene._replace(params=params), step=jnp.int32(20))
    take_step = jax.jit(lambda state: train_step(state, batch, config, moving=True, pair_capacity=4096)[0])
    labels = jax.tree.leaves(groups(params))
    for name in state.adam.schedules:
        rates = {
            group: schedule._replace(start=jnp.asarray(1e-3 if group == name else 0.0))
            for group, schedule in state.adam.schedules.items()
        }
        after = take_step(state._replace(adam=state.adam._replace(schedules=rates))).scene.params
        moved = {label for label, x, y in zip(labels, leaves, jax.tree.leaves(after), strict=True) if np.any(x != y)}
        assert moved == {name}


def test_parts_that_a_scene_lacks_have_no_learning_rate(dataset):
    """So its checkpoints have the layout of versions without these parts."""
    rates = initial_state(dataset, config_of(**{"model.motion_gate": False})).adam.schedules
    assert rates.keys() == set(RATE_GROUPS) - {"gate", "paths", "lifetimes", "exposures", "curves"}


def test_the_weights_of_opacity_scale_and_gate_apply_in_the_right_stage_and_unit(dataset):
    config = config_of()
    model = dataclasses.replace(config.model, motion_gate=True, unit="depth")
    bare = dataclasses.replace(config, model=model)
    state = initial_state(dataset, bare)
    gaussians = state.scene.params.gaussians
    alive = np.asarray(state.scene.alive)
    mean = lambda values: float(np.asarray(values)[alive].mean())
    sizes = {
        "opacity": mean(jax.nn.sigmoid(gaussians.logit_opacities)),
        "scale": mean(jnp.exp(gaussians.log_scales).mean(-1)) / float(state.scene.extent),
        "gate": mean(jax.nn.sigmoid(gaussians.gate)),
    }
    batch, probe = batch_of(dataset.train, [0, 3]), jnp.zeros((2, len(state.scene.alive), 2))

    @partial(jax.jit, static_argnums=1)
    def loss(weights, moving):
        config = overrides.replace(bare, {f"loss.{name}": weight for name, weight in weights.items()})
        return objective.objective(state.scene.params, probe, state, batch, config, moving, 4096)[0]

    for moving in (False, True):
        plain = loss(dict.fromkeys(sizes, 0.0), moving)
        for name, size in sizes.items():
            expected = 0 if name == "gate" and not moving else 2 * size
            added = loss(dict.fromkeys(sizes, 0.0) | {name: 2.0}, moving) - plain
            np.testing.assert_allclose(added, expected, rtol=1e-6, atol=1e-12, err_msg=name)


def test_rigidity_adds_its_term_times_its_weight_in_the_fine_stage(dataset):
    config = config_of(**{"loss.rigidity": 0.0})
    state, batch = initial_state(dataset, config), batch_of(dataset.train, [0, 3])
    params, probe = uneven(state.scene.params), jnp.zeros((2, len(state.scene.alive), 2))
    near = params.gaussians._replace(means=0.05 * params.gaussians.means)  # otherwise there are no neighbours
    params = params._replace(gaussians=near)

    @partial(jax.jit, static_argnums=(0, 1))
    def loss(weight, moving):
        weighted = overrides.replace(config, {"loss.rigidity": weight})
        value, (report, _) = objective.objective(params, probe, state, batch, weighted, moving, 4096)
        return value, report.terms

    (coarse, _), (coarse_too, _) = loss(0.0, False), loss(3.0, False)
    assert coarse == coarse_too
    (without, terms), (used, more) = loss(0.0, True), loss(3.0, True)
    assert more.keys() - terms.keys() == {"rigidity"}
    assert more["rigidity"] > 1e-4
    np.testing.assert_allclose(used - without, 3 * more["rigidity"], rtol=1e-9)


def test_given_depth_adds_its_term_times_its_weight(dataset):
    config = config_of(**{"loss.depth_input": 0.0})
    distances = np.random.default_rng(0).uniform(1, 3, dataset.train.images.shape[:-1]).astype(np.float32)
    state, batch = initial_state(dataset, config), batch_of(dataset.train, [0, 3])
    given = batch_of(dataclasses.replace(dataset.train, depths=distances), [0, 3])
    probe = jnp.zeros((2, len(state.scene.alive), 2))

    @jax.jit
    def losses():
        def loss(batch, weight):
            weighted = overrides.replace(config, {"loss.depth_input": weight})
            value, (report, _) = objective.objective(state.scene.params, probe, state, batch, weighted, False, 4096)
            return value, report.terms

        return loss(batch, 3.0), loss(given, 0.0), loss(given, 3.0)

    (without, _), (unused, terms), (used, more) = losses()
    assert without == unused
    assert more.keys() - terms.keys() == {"depth_input"}
    assert more["depth_input"] > 0.001
    np.testing.assert_allclose(used - unused, 3 * more["depth_input"], rtol=1e-9)


def test_without_sh_warmup_the_sh_degree_follows_the_length_of_the_run(dataset):
    config = dataclasses.replace(config_of(), coarse_steps=40, fine_steps=80, sh_warmup=None)
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, sh_degree=3))
    bands = [int(objective.sh_degree(number, config)) for number in (0, 19, 20, 40, 59, 60, 119)]
    assert bands == [0, 0, 1, 2, 2, 3, 3]


@pytest.mark.parametrize("bounded", [True, False])
def test_reflectances_stay_in_0_to_1_only_if_bounded(dataset, bounded):
    config = config_of(**{"model.bounded_reflectance": bounded, "optim.reflectance_lr": 0.3})
    state, batch = initial_state(dataset, config), batch_of(dataset.train, [0, 3])
    step = jax.jit(partial(train_step, config=config, moving=False, pair_capacity=4096))
    for _ in range(8):
        state, _ = step(state, batch)
    reflectance = state.scene.params.gaussians.reflectance
    assert bool(jnp.all((reflectance >= 0) & (reflectance <= 1))) is bounded
    assert bool(jnp.isfinite(reflectance).all())


@pytest.mark.parametrize(("unit_exponent", "b2"), [(None, 9.0), ("b1", 9.0), ("b2", 1.0)])
def test_the_initial_illumination_darkens_as_much_as_the_frames(dataset, unit_exponent, b2):
    config = config_of(**{"model.initial_illumination": "auto", "model.unit_exponent": unit_exponent})
    resolved = resolve(config, dataset)
    gain = split_darkening(dataset.train, resolved).gain
    assert resolved.model.initial_illumination**b2 == pytest.approx(gain, rel=0.02)


@pytest.mark.parametrize("tone", [1.0004, 9.9997])
def test_a_given_tone_is_the_exponent_that_training_starts_at(dataset, tone):
    config = config_of(**{"model.domain": "values", "model.tone": tone, "model.initial_exponents": ("auto", 9.0)})
    resolved = resolve(config, dataset)
    assert resolved.model.initial_exponents == (tone, 9.0)
    initial_state(dataset, resolved)
