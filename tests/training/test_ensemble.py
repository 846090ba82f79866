"""Many scenes trained by one program, on one device or several: each as if it were alone."""

import collections
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_training import FRAMES, HEIGHT, WIDTH, make_dataset, tiny

from l2dgs_jax.config import Config, DensityConfig, overrides
from l2dgs_jax.runtime import devices
from l2dgs_jax.training import engine, initial_state, step
from l2dgs_jax.training.batching import load_batch

STEPS, CAPACITY = 8, 1024
# Fine stage only, as every program takes long to compile; Gaussians are added after steps 3 and 6.
CONFIG = tiny(
    coarse_steps=0,
    fine_steps=STEPS,
    density=DensityConfig(start=1, stop=100, interval=3, grad_threshold=1e-9, max_gaussians=60),
)
OTHER_SETTINGS = {
    "seed": 3,
    "loss.exposure_level": 0.3,
    "loss.amplification": 0.1,
    "optim.planes_lr": 1e-3,
    "model.initial_exponents": (2.5, 8.0),
    "density.max_gaussians": 45,
}


def member(seed, changes=()):
    """A scene in training; the initial states of all members are drawn with the same settings."""
    dataset = make_dataset(seed)
    valid = np.random.default_rng(seed).random((FRAMES, HEIGHT, WIDTH)) < 0.7
    config = overrides.replace(CONFIG, dict(changes))
    initial = initial_state(dataset, CONFIG)
    # The quaternions of round Gaussians have no gradient except rounding errors, which Adam magnifies.
    gaussians = initial.scene.params.gaussians
    uneven = gaussians._replace(log_scales=gaussians.log_scales - jnp.array([[0.0, 0.5, 1.0]]))
    scene = initial.scene._replace(params=initial.scene.params._replace(gaussians=uneven))
    state = jax.jit(step.begin_stage, static_argnums=(2, 3))(scene, initial.step, config, STEPS)
    return engine.Member(dataclasses.replace(dataset.train, valid=valid), config, state)


@pytest.fixture(scope="module")
def members():
    return [member(0), member(1, OTHER_SETTINGS), member(2)]


def final_progress(members, pair_capacity=CAPACITY, mesh=None):
    return collections.deque(engine.run(members, pair_capacity, mesh), maxlen=1).pop()


@pytest.fixture(scope="module")
def alone(members):
    """The last step of each member when trained alone."""
    return [final_progress([one]) for one in members]


def assert_same_training(progress, index, alone):
    state, expected = devices.member(progress.states, index), devices.member(alone.states, 0)
    rows = len(expected.scene.alive)
    np.testing.assert_array_equal(state.scene.alive[:rows], expected.scene.alive)
    assert not state.scene.alive[rows:].any()
    for x, y in zip(*(jax.tree.leaves(s.scene.params) for s in (state, expected)), strict=True):
        np.testing.assert_allclose(x[: len(y)], y, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(progress.report.loss[index], alone.report.loss[0], rtol=1e-6)
    np.testing.assert_allclose(progress.report.psnr[index], alone.report.psnr[0], rtol=1e-6)
    assert state.step == expected.step


def test_each_member_trains_as_if_it_were_alone(members, alone):
    compiled = engine.train_steps._cache_size()
    together = final_progress(members)
    assert engine.train_steps._cache_size() == compiled + 1
    assert [int(progress.states.scene.alive.sum()) for progress in alone] == [60, 45, 60]
    for index, expected in enumerate(alone):
        assert_same_training(together, index, expected)


def test_a_member_that_diverges_is_frozen_and_the_others_go_on(members, alone):
    images = members[2].split.images.copy()
    images[2] = np.nan
    broken = members[2]._replace(
        split=dataclasses.replace(members[2].split, images=images, valid=members[2].split.valid | True)
    )
    steps = []
    for together in engine.run([*members[:2], broken], CAPACITY):
        steps.append(np.asarray(together.states.step).tolist())
    frozen = steps[-1][2]
    assert frozen < 3
    assert steps == [[step, step, min(step, frozen)] for step in range(1, STEPS + 1)]
    for index in range(2):
        assert_same_training(together, index, alone[index])
    with pytest.raises(engine.DivergedError, match=f"step {frozen}"):
        final_progress([broken])


def test_members_that_were_interrupted_at_different_steps_catch_up(members, alone):
    resumed = list(members)
    for index, stop_step in ((0, 3), (1, 6), (2, 6)):
        progress = next(p for p in engine.run([members[index]], CAPACITY) if p.step == stop_step)
        resumed[index] = members[index]._replace(state=devices.member(progress.states, 0))
    steps = []
    for together in engine.run(resumed, CAPACITY):
        steps.append(np.asarray(together.states.step).tolist())
    assert steps == [[step, max(step, 6), max(step, 6)] for step in range(4, STEPS + 1)]
    for index, expected in enumerate(alone):
        assert_same_training(together, index, expected)


@pytest.mark.slow
def test_views_of_a_batch_spread_over_devices_train_the_same(members, alone):
    assert_same_training(final_progress(members[:1], mesh=devices.mesh(views=2)), 0, alone[0])


@pytest.mark.slow
def test_members_spread_over_devices_train_as_if_alone(members, alone):
    """Three members on two devices: a fourth row is padding."""
    spread = final_progress(members, mesh=devices.mesh(2))
    assert list(devices.own_rows(spread.report.loss)) == [0, 1, 2, 3]
    for index, expected in enumerate(alone):
        assert_same_training(spread, index, expected)


@pytest.mark.slow
def test_a_small_pair_buffer_grows_without_changing_any_member(members, alone):
    together = final_progress(members, pair_capacity=8)
    assert together.pair_capacity > 8
    for index, expected in enumerate(alone):
        assert_same_training(together, index, expected)


@pytest.mark.slow
@pytest.mark.parametrize(
    "forms", [{}, {"density.method": "mcmc", "model.motion_gate": True, "model.unit": "depth"}], ids=["plain", "mcmc"]
)
def test_every_setting_that_members_may_differ_in_can_be_traced(forms):
    """A step with traced settings equals one with the same settings compiled in."""
    optional = {"loss.structure_illumination": 0.3, "loss.structure_beta_illumination": 0.2, "optim.decay_steps": 7}
    subject = member(0, optional | {"loss.amplification": 0.02, "loss.gate": 0.03} | forms)
    config, batch = subject.config, load_batch(subject.split, np.array([0, 3]))
    values = {
        name: jax.tree.map(jnp.asarray, value)
        for name, (value, _) in overrides.differences([config, _all_changed(config)]).items()
    }
    assert set(values) == overrides.TRACED

    @jax.jit
    def traced(state, batch, values):
        settings = overrides.replace(_all_changed(config), values)
        begun = step.begin_stage(state.scene, state.step, settings, 9)
        return step.densify(step.train_step(begun, batch, settings, moving=True, pair_capacity=4096)[0], settings, 2)

    @jax.jit
    def compiled_in(state, batch):
        begun = step.begin_stage(state.scene, state.step, config, 9)
        return step.densify(step.train_step(begun, batch, config, moving=True, pair_capacity=4096)[0], config, 2)

    for x, y in zip(
        *map(jax.tree.leaves, (traced(subject.state, batch, values), compiled_in(subject.state, batch))), strict=True
    ):
        np.testing.assert_allclose(x, y, rtol=1e-6, atol=1e-8)


def _all_changed(config: Config) -> Config:
    """A config that differs in every number of `TRACED`."""
    shift = lambda value: tuple(map(shift, value)) if isinstance(value, tuple) else value + 1
    values = {name: value for name, (value, _) in overrides.differences([config, overrides.outline(config)]).items()}
    zeros = {name: overrides.read(config, name) for name in overrides.TRACED - set(values)}
    return overrides.replace(config, {name: shift(value) for name, value in (values | zeros).items()})
