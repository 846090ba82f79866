"""Adam compared with a plain NumPy version; parameter groups, schedules, and jaxopt driving the steps."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from l2dgs_jax.config import OptimConfig
from l2dgs_jax.config.settings import RATE_GROUPS
from l2dgs_jax.errors import UserError
from l2dgs_jax.training import optimizer
from l2dgs_jax.training.parameter_groups import schedules


def constant(rate):
    return optimizer.Schedule(jnp.array(rate), jnp.array(rate), jnp.array(1.0))


def numpy_adam(value, gradients, rates, beta1, beta2, eps):
    m = v = np.zeros_like(value)
    for t, (gradient, rate) in enumerate(zip(gradients, rates, strict=True), start=1):
        m = beta1 * m + (1 - beta1) * gradient
        v = beta2 * v + (1 - beta2) * gradient**2
        value = value - rate * (m / (1 - beta1**t)) / (np.sqrt(v / (1 - beta2**t)) + eps)
    return value


def test_adam_matches_numpy_in_every_group():
    rng = np.random.default_rng(0)
    params = {"a": jnp.array(rng.normal(size=3)), "b": (jnp.array(rng.normal(size=(2, 2))),)}
    groups = {"a": "fast", "b": ("slow",)}
    rates = {"fast": constant(0.3), "slow": optimizer.Schedule(jnp.array(0.1), jnp.array(0.001), jnp.array(10.0))}
    adam = optimizer.adam(groups, rates, 0.8, 0.95, 1e-8)
    gradients = [jax.tree.map(lambda p: jnp.array(rng.normal(size=p.shape)), params) for _ in range(20)]

    moved, state = params, adam.init(params)
    for gradient in gradients:
        step, state = adam.update(gradient, state, moved)
        moved = jax.tree.map(jnp.add, moved, step)

    decayed = [0.1 * 0.01 ** min(t / 10, 1) for t in range(20)]
    expected_a = numpy_adam(np.array(params["a"]), [np.array(g["a"]) for g in gradients], [0.3] * 20, 0.8, 0.95, 1e-8)
    expected_b = numpy_adam(
        np.array(params["b"][0]), [np.array(g["b"][0]) for g in gradients], decayed, 0.8, 0.95, 1e-8
    )
    np.testing.assert_allclose(moved["a"], expected_a, rtol=1e-12)
    np.testing.assert_allclose(moved["b"][0], expected_b, rtol=1e-12)


def test_first_step_has_the_size_of_the_learning_rate_whatever_the_gradient():
    adam = optimizer.adam("g", {"g": constant(0.01)}, 0.9, 0.999, 1e-15)
    gradient = jnp.array([1e-6, 1.0, -1e6])
    step, _ = adam.update(gradient, adam.init(gradient), gradient)
    np.testing.assert_allclose(step, [-0.01, -0.01, 0.01], rtol=1e-6)


def test_rows_without_gradient_do_not_move():
    adam = optimizer.adam("g", {"g": constant(0.01)}, 0.9, 0.999, 1e-15)
    step, _ = adam.update(jnp.zeros(3), adam.init(jnp.zeros(3)), jnp.zeros(3))
    np.testing.assert_array_equal(step, 0)


def test_jaxopt_minimises_with_adam_and_one_vmapped_update_serves_different_rates():
    target = jnp.array([1.0, -2.0])

    def value_and_grad(x):
        value, gradient = jax.value_and_grad(lambda x: jnp.sum((x - target) ** 2))(x)
        return (value, ()), gradient

    def steps(rate, count):
        adam = optimizer.adam("g", {"g": constant(rate)}, 0.9, 0.999, 1e-15)
        params = jnp.zeros(2)
        state = adam.init(params)
        for _ in range(count):
            params, state, auxiliary, norm = optimizer.take_step(value_and_grad, adam, params, state)
            assert auxiliary == ()
            assert norm.shape == ()
        return params

    together = jax.vmap(lambda rate: steps(rate, 5))(jnp.array([0.1, 0.2]))
    np.testing.assert_allclose(together[0], steps(0.1, 5))
    np.testing.assert_allclose(together[1], steps(0.2, 5))
    assert jnp.sum((steps(0.2, 60) - target) ** 2) < 0.1


def test_a_schedule_decays_exponentially_and_then_stays_constant():
    schedule = optimizer.Schedule(jnp.array(1.0), jnp.array(0.01), jnp.array(100.0))
    rates = [float(optimizer.learning_rate(schedule, jnp.array(count))) for count in (0, 50, 100, 1000)]
    np.testing.assert_allclose(rates, [1.0, 0.1, 0.01, 0.01], rtol=1e-6)


def test_a_rate_of_zero_freezes_its_group():
    schedule = optimizer.Schedule(jnp.array(0.0), jnp.array(0.0), jnp.array(100.0))
    assert float(optimizer.learning_rate(schedule, jnp.array(7))) == 0


def test_the_extent_scales_the_rates_of_the_groups_named():
    cfg = OptimConfig(extent_scales=("means",), decay_steps=None)
    plain, scaled = (schedules(cfg, jnp.array(extent), 70) for extent in (1.0, 3.0))
    for name in plain:
        np.testing.assert_allclose(scaled[name].start, (3.0 if name == "means" else 1.0) * plain[name].start)
        assert plain[name].steps == 70


def test_a_group_that_does_not_exist_cannot_be_scaled():
    with pytest.raises(UserError, match=r"--optim\.extent-scales plane: expected some of means"):
        OptimConfig(extent_scales=("means", "plane"))
    assert set(RATE_GROUPS) == schedules(OptimConfig(), jnp.array(1.0), 70).keys()


def test_a_group_without_a_rate_is_an_error():
    with pytest.raises(ValueError, match="nonsuch"):
        optimizer.adam({"a": "nonsuch"}, {"g": constant(0.1)}, 0.9, 0.999, 1e-8)


def test_optax_is_not_imported():
    code = "import sys, l2dgs_jax.training.engine, l2dgs_jax.train; sys.exit('optax' in sys.modules)"
    assert subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=False).returncode == 0


def test_optax_is_not_required():
    from importlib.metadata import requires

    assert not any("optax" in requirement for requirement in requires("l2dgs-jax"))
