"""A training step of one scene as pure functions: the update, the start of a stage, densification."""

from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.config import Config
from l2dgs_jax.model.deformation import has_path
from l2dgs_jax.runtime import devices
from l2dgs_jax.training import densification, optimizer, relocation
from l2dgs_jax.training.objective import objective
from l2dgs_jax.training.parameter_groups import groups, schedules
from l2dgs_jax.training.state import Batch, StepReport, TrainState, map_gaussians, randomness
from l2dgs_jax.types import Gaussians, Scene, SceneParams

T = TypeVar("T")


def train_step(
    state: TrainState,
    batch: Batch,
    config: Config,
    *,
    moving: bool,
    pair_capacity: int,
    at: Int[Array, ""] | int | None = None,
    axis: str | None = None,
) -> tuple[TrainState, StepReport]:
    """One Adam step on one batch; if pairs overflowed or a value is not finite, the report says so and the state stays.

    Args:
        state: before the step.
        batch: its views, or with `axis` this device's share of them, the same number on each.
        config: settings; the numbers of `overrides.TRACED` may be traced.
        moving: whether it is a step of the fine stage.
        pair_capacity: size of the pair buffer for the views given.
        at: the number of this step: a state that has not come that far, or is past it, is left as it was.
        axis: of `jax.shard_map`, over which the views of the batch are spread. Gradients and statistics are those of
            all views, and the same on every device.
    """
    dtype = state.stats.seen.dtype
    batch = jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, batch)

    def value_and_grad(params: SceneParams) -> tuple:
        probe = jnp.zeros((*batch.cameras.time.shape, state.scene.alive.shape[0], 2), batch.images.dtype)
        (loss, (report, radii)), (gradient, probe_gradient) = jax.value_and_grad(objective, (0, 1), has_aux=True)(
            params, probe, state, batch, config, moving, pair_capacity, axis
        )
        loss, gradient, probe_sum = devices.mean_over((loss, gradient, probe_gradient.sum(0)), axis)
        return (loss, (report._replace(loss=loss), devices.max_over(radii.max(0), axis), probe_sum)), gradient

    transformation = adam(state.scene.params, state.adam.schedules, config, _pace(state, config))
    params, adam_state, (report, radii, probe_gradient), norm = optimizer.take_step(
        value_and_grad, transformation, state.scene.params, state.adam
    )

    if config.model.bounded_reflectance:
        bounded = jnp.clip(params.gaussians.reflectance, 0, 1)
        params = params._replace(gaussians=params.gaussians._replace(reflectance=bounded))
    if config.density.method == "mcmc":
        params = params._replace(gaussians=_disturbed(params.gaussians, state, config))
    height, width = batch.images.shape[1:3]
    report = report._replace(
        terms=devices.mean_over(report.terms, axis),
        pairs=devices.max_over(report.pairs, axis),
        overflow=devices.max_over(report.overflow.astype(jnp.int32), axis) > 0,
        finite=jnp.isfinite(report.loss) & jnp.isfinite(norm),
    )
    stepped = TrainState(
        scene=state.scene._replace(params=params),
        adam=adam_state,
        stats=densification.accumulate(state.stats, probe_gradient, radii, width, height),
        step=state.step + 1,
    )
    taken = report.finite & ~report.overflow
    if at is not None:
        taken &= state.step == at
    return tree_where(taken, stepped, state), report


def _disturbed(gaussians: Gaussians, state: TrainState, config: Config) -> Gaussians:
    """The Gaussians after the noise of this step, which fades with the learning rate of the centres."""
    scene, cfg = state.scene, config.density
    rate = optimizer.learning_rate(state.adam.schedules["means"], state.adam.step + 1)
    size = cfg.noise * _pace(state, config) * rate / jnp.where(scene.extent > 0, scene.extent, 1) ** 2
    key = jax.random.fold_in(randomness(state, config), 1)
    return relocation.disturb(gaussians, scene.alive, size, key, cfg.prune_opacity)


def cooldown(step: Float[Array, ""] | int, config: Config) -> Float[Array, ""]:
    """The factor on all learning rates after `step` steps of the run, which falls to 0 in `optim.cooldown` of it."""
    share, left = config.optim.cooldown, 1 - step / config.steps
    return jnp.where(share > 0, jnp.minimum(left / jnp.where(share > 0, share, 1.0), 1.0), 1.0)


def _pace(state: TrainState, config: Config) -> Float[Array, ""]:
    return cooldown(state.step.astype(state.stats.seen.dtype), config)


def adam(
    params: SceneParams,
    rates: dict[str, optimizer.Schedule],
    config: Config,
    factor: Float[Array, ""] | float = 1.0,
) -> optimizer.Transformation:
    """The optimizer of all of `params`; `factor` is on all rates."""
    return optimizer.adam(groups(params), rates, config.optim.beta1, config.optim.beta2, config.optim.eps, factor)


def begin_stage(scene: Scene, step: Int[Array, ""], config: Config, stage_steps: int) -> TrainState:
    """A state with fresh optimizer moments, schedules and statistics, as 4DGS starts each stage.

    Args:
        scene: as it stands.
        step: number of finished steps of the run.
        config: settings.
        stage_steps: length of the stage that begins.
    """
    used = set(jax.tree.leaves(groups(scene.params)))
    rates = {name: rate for name, rate in schedules(config.optim, scene.extent, stage_steps).items() if name in used}
    transformation = adam(scene.params, rates, config)
    return TrainState(scene, transformation.init(scene.params), densification.empty_stats(scene.alive.shape[0]), step)


def densify(state: TrainState, config: Config, growths_left: Int[Array, ""] | int) -> tuple[TrainState, Int[Array, ""]]:
    """Change the number of Gaussians; also the capacity to be called again with if rows ran out, otherwise 0.

    Args:
        state: after a step.
        config: settings.
        growths_left: how often the stage grows from now on, this time included.
    """
    scene, cfg, key = state.scene, config.density, randomness(state, config)
    if cfg.method == "mcmc":
        count = relocation.population(scene.alive.sum(), densification.most_gaussians(cfg), growths_left)
        own = jax.random.fold_in(key, 0)
        need = state.stats.gradient if cfg.drawn_by == "gradient" else None
        gaussians, dead_below = scene.params.gaussians, cfg.prune_opacity
        result = relocation.relocate(gaussians, scene.alive, count, own, dead_below, cfg.spread, need)
    else:
        result = densification.densify(scene.params.gaussians, scene.alive, state.stats, scene.extent, key, cfg)

    path_of = jax.tree.map(lambda rows: rows[result.source], scene.path_of)

    def reset(rows: Float[Array, "..."], changed: Bool[Array, "..."]) -> Float[Array, "..."]:
        return jnp.where(changed.reshape(-1, *[1] * (rows.ndim - 1)), 0, rows)

    def renewed(moments: SceneParams) -> SceneParams:
        """Moments of Gaussians, and of paths whose followers change, start anew."""
        paths = moments.paths
        if paths is not None and path_of is not None and result.gaussians.lifetimes is not None:
            follows = result.changed & has_path(result.gaussians.lifetimes)
            own = jnp.where(follows, path_of, len(paths))
            paths = reset(paths, jnp.zeros(len(paths), bool).at[own].set(True, mode="drop"))
        return map_gaussians(partial(reset, changed=result.changed), moments)._replace(paths=paths)

    grown = TrainState(
        scene=scene._replace(
            params=scene.params._replace(gaussians=result.gaussians), alive=result.alive, path_of=path_of
        ),
        adam=state.adam._replace(mu=renewed(state.adam.mu), nu=renewed(state.adam.nu)),
        stats=jax.tree.map(jnp.zeros_like, state.stats),
        step=state.step,
    )
    return grown, jnp.where(result.missing > 0, scene.alive.sum() + result.wanted, 0)


def tree_where(condition: Bool[Array, ""], new: T, old: T) -> T:
    """`new` if the condition holds, else `old`."""
    return jax.tree.map(lambda new, old: jnp.where(condition, new, old), new, old)
