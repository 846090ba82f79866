"""Adam with a learning rate per parameter group, driven by jaxopt, which no other module imports."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # jaxopt announces that it is unmaintained
    from jaxopt import OptaxSolver
    from jaxopt._src.optax_wrapper import OptaxState

Params = TypeVar("Params")


class Schedule(NamedTuple):
    """A learning rate that decays exponentially from `start` to `end` over `steps`, then stays."""

    start: Float[Array, "*S"]
    end: Float[Array, "*S"]
    steps: Float[Array, "*S"]


class AdamState(NamedTuple):
    """First and second moments, and the schedule of each group.

    Schedules are state and not settings, so that one vmapped update serves scenes with different learning rates.
    """

    step: Int[Array, "*S"]
    mu: PyTree
    nu: PyTree
    schedules: dict[str, Schedule]


class Transformation(NamedTuple):
    """`init(params) -> state` and `update(gradients, state, params) -> (step, new state)`; the step is to be added."""

    init: Callable[[PyTree], AdamState]
    update: Callable[[PyTree, AdamState, PyTree], tuple[PyTree, AdamState]]


def learning_rate(schedule: Schedule, count: Int[Array, "*S"]) -> Float[Array, "*S"]:
    """The rate start (end / start)^(count / steps), with count / steps at most 1; 0 where start is 0."""
    progress = jnp.minimum(count.astype(schedule.start.dtype) / schedule.steps, 1.0)
    start = jnp.where(schedule.start > 0, schedule.start, 1.0)
    return jnp.where(schedule.start > 0, start * (schedule.end / start) ** progress, 0.0)


@jax.jit
def learning_rates(schedules: dict[str, Schedule], count: Int[Array, "*S"]) -> dict[str, Float[Array, "*S"]]:
    """The rate of every group after `count` steps."""
    return {name: learning_rate(schedule, count) for name, schedule in schedules.items()}


def adam(
    groups: PyTree,
    rates: dict[str, Schedule],
    beta1: Float[Array, ""] | float,
    beta2: Float[Array, ""] | float,
    eps: Float[Array, ""] | float,
    factor: Float[Array, ""] | float = 1.0,
) -> Transformation:
    """Adam (Kingma and Ba, arXiv 1412.6980) with bias correction and one schedule per group.

    Args:
        groups: a group name for every leaf of the parameters.
        rates: the schedule of every group.
        beta1: decay of the first moment.
        beta2: decay of the second moment.
        eps: added to the root of the second moment.
        factor: on all rates.

    Raises:
        ValueError: a leaf's group has no schedule.
    """
    unknown = set(jax.tree.leaves(groups)) - set(rates)
    if unknown:
        raise ValueError(f"parameter groups {sorted(unknown)} have no learning rate; known: {sorted(rates)}")

    def init(params: PyTree) -> AdamState:
        # Two trees of zeros, not one used twice: donated buffers must not be shared.
        return AdamState(
            step=jnp.zeros((), jnp.int32),
            mu=jax.tree.map(jnp.zeros_like, params),
            nu=jax.tree.map(jnp.zeros_like, params),
            schedules=rates,
        )

    def update(gradients: PyTree, state: AdamState, params: PyTree) -> tuple[PyTree, AdamState]:
        del params
        step = state.step + 1
        mu = jax.tree.map(lambda m, g: beta1 * m + (1 - beta1) * g, state.mu, gradients)
        nu = jax.tree.map(lambda v, g: beta2 * v + (1 - beta2) * jnp.square(g), state.nu, gradients)
        lr = {name: learning_rate(schedule, state.step) for name, schedule in state.schedules.items()}

        def move(group: str, m: Float[Array, "..."], v: Float[Array, "..."]) -> Float[Array, "..."]:
            t = step.astype(m.dtype)
            return -factor * lr[group] * (m / (1 - beta1**t)) / (jnp.sqrt(v / (1 - beta2**t)) + eps)

        return jax.tree.map(move, groups, mu, nu), AdamState(step, mu, nu, state.schedules)

    return Transformation(init, update)


def take_step(
    value_and_gradient: Callable[[Params], tuple[tuple[Float[Array, ""], Any], Params]],
    transformation: Transformation,
    params: Params,
    state: AdamState,
) -> tuple[Params, AdamState, Any, Float[Array, ""]]:
    """One step of a jaxopt solver.

    Args:
        value_and_gradient: of the parameters: ((loss, auxiliary), gradient).
        transformation: turns a gradient into a step.
        params: before the step.
        state: of Adam, before the step.

    Returns:
        Parameters and Adam's state after the step, the auxiliary output, and the gradient's norm.
    """
    solver = OptaxSolver(value_and_gradient, transformation, value_and_grad=True, has_aux=True, jit=False)
    zero = jnp.zeros((), jnp.result_type(*jax.tree.leaves(params)))
    before = OptaxState(iter_num=state.step, value=zero, error=zero, internal_state=state, aux=None)
    params, after = solver.update(params, before)
    return params, after.internal_state, after.aux, after.error
