"""Adam with a learning rate per parameter group, as the (init, update) pair that `jaxopt.OptaxSolver` drives."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from l2dgs_jax.config import OptimConfig


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


def schedules(cfg: OptimConfig, extent: Float[Array, ""], stage_steps: int) -> dict[str, Schedule]:
    """The schedule of every group that `scene.groups` names.

    Args:
        cfg: rates and decay.
        extent: world units, multiplies the rates of `cfg.extent_scales`.
        stage_steps: length of a decay where `cfg.decay_steps` is None.
    """
    rates = {
        "means": (cfg.means_lr, cfg.means_lr_end),
        "heads": (cfg.heads_lr, cfg.heads_lr_end),
        "planes": (cfg.planes_lr, cfg.planes_lr_end),
        "ocd": (cfg.ocd_lr, cfg.ocd_lr_end),
        "bafe": (cfg.bafe_lr, cfg.bafe_lr_end),
        "illumination": (cfg.illumination_lr, cfg.illumination_lr),
        "illumination_rest": (cfg.illumination_lr / cfg.illumination_rest_divisor,) * 2,
        "reflectance": (cfg.reflectance_lr, cfg.reflectance_lr),
        "attenuation": (cfg.attenuation_lr, cfg.attenuation_lr),
        "opacities": (cfg.opacity_lr, cfg.opacity_lr),
        "scales": (cfg.scales_lr, cfg.scales_lr),
        "quats": (cfg.quats_lr, cfg.quats_lr),
    }
    steps = jnp.maximum(stage_steps if cfg.decay_steps is None else cfg.decay_steps, 1)
    factor = lambda name: extent if name in cfg.extent_scales else jnp.ones_like(extent)
    return {
        name: Schedule(start * factor(name), end * factor(name), jnp.full_like(extent, steps))
        for name, (start, end) in rates.items()
    }


def adam(
    groups: PyTree,
    rates: dict[str, Schedule],
    beta1: Float[Array, ""] | float,
    beta2: Float[Array, ""] | float,
    eps: Float[Array, ""] | float,
) -> Transformation:
    """Adam (Kingma and Ba, arXiv 1412.6980) with bias correction and one schedule a group.

    Args:
        groups: a group name for every leaf of the parameters.
        rates: the schedule of every group.
        beta1: decay of the first moment.
        beta2: decay of the second moment.
        eps: added to the root of the second moment.

    Raises:
        ValueError: a leaf's group has no schedule.
    """
    unknown = set(jax.tree.leaves(groups)) - set(rates)
    if unknown:
        raise ValueError(f"parameter groups {sorted(unknown)} have no learning rate; known: {sorted(rates)}")

    def init(params: PyTree) -> AdamState:
        # Two trees of zeros, not one used twice: buffers that are donated may not be shared.
        zeros = lambda: jax.tree.map(jnp.zeros_like, params)
        return AdamState(jnp.zeros((), jnp.int32), zeros(), zeros(), rates)

    def update(gradients: PyTree, state: AdamState, params: PyTree) -> tuple[PyTree, AdamState]:
        del params
        step = state.step + 1
        mu = jax.tree.map(lambda m, g: beta1 * m + (1 - beta1) * g, state.mu, gradients)
        nu = jax.tree.map(lambda v, g: beta2 * v + (1 - beta2) * jnp.square(g), state.nu, gradients)
        lr = {name: learning_rate(schedule, state.step) for name, schedule in state.schedules.items()}

        def move(group: str, m: Float[Array, "..."], v: Float[Array, "..."]) -> Float[Array, "..."]:
            t = step.astype(m.dtype)
            return -lr[group] * (m / (1 - beta1**t)) / (jnp.sqrt(v / (1 - beta2**t)) + eps)

        return jax.tree.map(move, groups, mu, nu), AdamState(step, mu, nu, state.schedules)

    return Transformation(init, update)
