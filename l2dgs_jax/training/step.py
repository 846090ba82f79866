"""A training step of one scene as pure functions: the objective, the update, the start of a stage, densification."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from l2dgs_jax.config import Config, LossConfig
from l2dgs_jax.model import hexplane, tone_curves
from l2dgs_jax.model.deformation import length_unit
from l2dgs_jax.model.initialisation import pad_rows
from l2dgs_jax.model.rendering import render
from l2dgs_jax.training import densification, losses, optimizer, relocation
from l2dgs_jax.training.densification import GrowthStats
from l2dgs_jax.training.given_depth import depth_disagreement
from l2dgs_jax.training.parameter_groups import groups, schedules
from l2dgs_jax.types import Camera, Gaussians, Scene, SceneParams, ToneCurves

T = TypeVar("T")


class Batch(NamedTuple):
    """The views of one step.

    Attributes:
        cameras: of the views.
        images: sRGB in [0, 1].
        frames: which of the training frames they are.
        valid: where there is something to learn; None for everywhere.
        depths: as in `Split`, 0 where unknown or not to be learned; None if the scene has none.
    """

    cameras: Camera
    images: Float[Array, "*S V H W 3"]
    frames: Int[Array, "*S V"]
    valid: Bool[Array, "*S V H W"] | None = None
    depths: Float[Array, "*S V H W"] | None = None


class TrainState(NamedTuple):
    """All that a step reads and writes, and all that a checkpoint holds. `step` counts finished steps."""

    scene: Scene
    adam: optimizer.AdamState
    stats: GrowthStats
    step: Int[Array, "*S"]


class StepReport(NamedTuple):
    """What a step found. The state is unchanged if the pair buffer overflowed or a gradient was not finite.

    Attributes:
        loss: Eq. 15 plus the plane regularisers.
        terms: each term, unweighted.
        psnr: of the low-light estimate against the input, dB, before the step.
        pairs: (Gaussian, tile) pairs that the step needs; where views are spread over devices, on the fullest one.
        overflow: whether they did not fit.
        finite: whether loss and gradient are.
    """

    loss: Float[Array, "*S"]
    terms: dict[str, Float[Array, "*S"]]
    psnr: Float[Array, "*S"]
    pairs: Int[Array, "*S"]
    overflow: Bool[Array, "*S"]
    finite: Bool[Array, "*S"]


def sh_degree(step: Int[Array, ""] | int, config: Config) -> Int[Array, ""] | int:
    """SH bands in use after `step` steps: one more every `config.sh_warmup`."""
    warmup = config.steps // (2 * max(config.model.sh_degree, 1)) if config.sh_warmup is None else config.sh_warmup
    return jnp.minimum(step // max(warmup, 1), config.model.sh_degree)


def exponent_target(config: Config) -> float | Float[Array, ""]:
    """Where the prior of `config.loss.exponent_prior` pulls B1: its start, or 1 if that is left to chance."""
    start = config.model.initial_exponents
    return start[0] if start else 1.0  # type: ignore[return-value]  # "auto" is resolved by then


def objective(
    params: SceneParams,
    probe: Float[Array, "V N 2"],
    state: TrainState,
    batch: Batch,
    config: Config,
    moving: bool,
    pair_capacity: int,
    axis: str | None = None,
) -> tuple[Float[Array, ""], tuple[StepReport, Float[Array, "V N"]]]:
    """Eq. 15 plus the plane regularisers of 4DGS (arXiv 2310.08528) and what `LossConfig` adds, for one batch.

    Gradients flow to `params` and to `probe`, zeros added to the projected centres. The loss is that of the views at
    hand: with views spread over the devices of `axis`, its mean over them is the loss of all views.

    Args:
        params: of the scene, in place of those that `state` holds.
        probe: zeros, pixels.
        state: the scene, and which step this is.
        batch: V views.
        config: settings.
        moving: whether it is a step of the fine stage.
        pair_capacity: size of the pair buffer for the views at hand.
        axis: see `train_step`.

    Returns:
        The loss, and (the report, the Gaussians' radii in every view, pixels).
    """
    height, width = batch.images.shape[1:3]
    output = render(
        state.scene._replace(params=params),
        batch.cameras,
        config.model,
        width,
        height,
        moving=moving,
        sh_degree=sh_degree(state.step, config),
        pair_capacity=pair_capacity,
        means2d_probe=probe,
        presence=presence(state, config),
        chances=chances(state, config),
    )
    cfg = config.loss
    start, steps = (config.coarse_steps, config.fine_steps) if moving else (0, config.coarse_steps)
    eta = losses.eta(state.step - start, steps, cfg) if cfg.eta_restarts else losses.eta(state.step, config.steps, cfg)
    images = output.images
    if params.curves is not None:
        own = tone_curves.of_frames(params.curves, batch.frames)
        images = images._replace(lowlight=tone_curves.darkened(images.welllit, own))
    images = images._replace(lowlight=exposed(images.lowlight, params.exposures, batch.frames))
    target, counted = targets(batch, images.lowlight)
    measured = output._replace(images=images, depth=output.depth / length_unit(state.scene.extent, config.model))
    loss, terms = losses.total(measured, target, cfg, eta, exponent_target(config))
    if moving:
        smoothness, time_smoothness, time_l1 = hexplane.regularisers(params.hexplane)
        loss += cfg.plane_smoothness * smoothness + cfg.time_smoothness * time_smoothness + cfg.time_l1 * time_l1
    others = size_terms(state.scene._replace(params=params), config, moving) | curve_terms(params.curves, batch, cfg)
    if batch.depths is not None:
        depths = batch.depths
        others["depth_input"] = (cfg.depth_input, lambda: depth_disagreement(output.depth, output.alpha, depths))
    other, values = losses.weighted_sum(others)
    loss, terms = loss + other, terms | values
    squares = jnp.mean(jnp.square(jax.lax.stop_gradient(images.lowlight) - target))
    mse = _mean(squares, axis) / _mean(counted, axis)
    report = StepReport(loss, terms, -10 * jnp.log10(mse), output.pairs, output.overflow, jnp.isfinite(loss))
    return loss, (report, output.radii)


def size_terms(scene: Scene, config: Config, moving: bool) -> losses.Terms:
    """Weight and value of what keeps Gaussians few, small and still: means over those that are alive."""
    gaussians, alive, cfg = scene.params.gaussians, scene.alive, config.loss

    def mean(values: Float[Array, " N"]) -> Float[Array, ""]:
        return jnp.where(alive, values, 0).sum() / jnp.maximum(alive.sum(), 1).astype(values.dtype)

    def scale() -> Float[Array, ""]:
        # Garbage in a dead row could overflow the exponential, and 0 * inf would be a gradient of NaN.
        scales = jnp.exp(jnp.where(alive[:, None], gaussians.log_scales, 0))
        return mean(scales.mean(-1)) / length_unit(scene.extent, config.model)

    terms: losses.Terms = {
        "opacity": (cfg.opacity, lambda: mean(jax.nn.sigmoid(gaussians.logit_opacities))),
        "scale": (cfg.scale, scale),
    }
    if moving and gaussians.gate is not None:
        gate = gaussians.gate
        terms["gate"] = (cfg.gate, lambda: mean(jax.nn.sigmoid(gate)))
    return terms


def curve_terms(curves: ToneCurves | None, batch: Batch, cfg: LossConfig) -> losses.Terms:
    """Weight and value of what gives the frames' tone curves their shape."""
    if curves is None:
        return {}
    own = tone_curves.of_frames(curves, batch.frames)
    return {
        "equalisation": (cfg.equalisation, lambda: tone_curves.equalisation(own, batch.images, batch.valid)),
        "bend": (cfg.bend, lambda: tone_curves.bend(own)),
    }


def presence(state: TrainState, config: Config) -> Float[Array, " N"] | None:
    """Factors on the opacities of this step: 0 for those that it leaves out (DropGaussian, arXiv 2504.09491).

    Their share grows evenly up to `config.drop` at the end of the run; the others make up for it.
    """
    if isinstance(config.drop, float) and config.drop == 0:
        return None
    share = config.drop * state.step.astype(state.stats.seen.dtype) / config.steps
    key = jax.random.fold_in(_key(state, config), 3)
    return jnp.where(jax.random.bernoulli(key, share, state.scene.alive.shape), 0, 1 / (1 - share))


def chances(state: TrainState, config: Config) -> Float[Array, " N"] | None:
    """What makes the motion field act on Gaussians at random in this step, in proportion to the odds of their gates.

    Added to logits, Gumbel noise draws without replacement (arXiv 1903.06059): gates that have closed may open again.
    """
    if not (config.model.motion_gate and config.model.moving_share < 1):
        return None
    key = jax.random.fold_in(_key(state, config), 4)
    return jax.random.gumbel(key, state.scene.alive.shape, state.stats.seen.dtype)


def exposed(
    lowlight: Float[Array, "V H W 3"], exposures: Float[Array, "F 3"] | None, frames: Int[Array, " V"]
) -> Float[Array, "V H W 3"]:
    """Low-light estimates as the camera exposed those training frames; both carry gradients.

    Gains count relative to their geometric mean, which the scene's own brightness stands for.
    """
    if exposures is None:
        return lowlight
    return lowlight * jnp.exp(exposures - exposures.mean(0, keepdims=True))[frames][:, None, None]


def targets(
    batch: Batch, estimate: Float[Array, "V H W 3"]
) -> tuple[Float[Array, "V H W 3"], Float[Array, ""] | float]:
    """What the low-light estimate is compared with, and the share of pixels that count.

    Where pixels are not valid the estimate is compared with itself, held constant: nothing can be learned there.
    """
    if batch.valid is None:
        return batch.images, 1.0
    target = jnp.where(batch.valid[..., None], batch.images, jax.lax.stop_gradient(estimate))
    return target, jnp.maximum(batch.valid.mean(dtype=target.dtype), 1e-6)


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
    """One Adam step on one batch; a step that cannot be trusted leaves the state as it was and says so.

    Args:
        state: before the step.
        batch: its views, or with `axis` this device's share of them, the same number on each.
        config: settings; the numbers of `overrides.TRACED` may be traced.
        moving: whether it is a step of the fine stage.
        pair_capacity: size of the pair buffer for the views at hand.
        at: the number of this step: a state that has not come that far, or is past it, is left as it was.
        axis: of `jax.shard_map`, over which the views of the batch are spread. Gradients and statistics are those of
            all views, and every device returns the same.
    """
    dtype = state.stats.seen.dtype
    batch = jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, batch)

    def value_and_grad(params: SceneParams) -> tuple:
        probe = jnp.zeros((*batch.cameras.time.shape, state.scene.alive.shape[0], 2), batch.images.dtype)
        (loss, (report, radii)), (gradient, probe_gradient) = jax.value_and_grad(objective, (0, 1), has_aux=True)(
            params, probe, state, batch, config, moving, pair_capacity, axis
        )
        loss, gradient, moved = _mean((loss, gradient, probe_gradient.sum(0)), axis)
        return (loss, (report._replace(loss=loss), _max(radii.max(0), axis), moved)), gradient

    transformation = adam(state.scene.params, state.adam.schedules, config)
    params, adam_state, (report, radii, moved), norm = optimizer.take_step(
        value_and_grad, transformation, state.scene.params, state.adam
    )

    if config.density.method == "mcmc":
        params = params._replace(gaussians=_disturbed(params.gaussians, state, config))
    height, width = batch.images.shape[1:3]
    report = report._replace(
        terms=_mean(report.terms, axis),
        pairs=_max(report.pairs, axis),
        overflow=_max(report.overflow.astype(jnp.int32), axis) > 0,
        finite=jnp.isfinite(report.loss) & jnp.isfinite(norm),
    )
    stepped = TrainState(
        scene=state.scene._replace(params=params),
        adam=adam_state,
        stats=densification.accumulate(state.stats, moved, radii, width, height),
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
    size = cfg.noise * rate / jnp.where(scene.extent > 0, scene.extent, 1) ** 2
    key = jax.random.fold_in(_key(state, config), 1)
    return relocation.disturb(gaussians, scene.alive, size, key, cfg.prune_opacity)


def _key(state: TrainState, config: Config) -> PRNGKeyArray:
    """Randomness of this step."""
    return jax.random.fold_in(jax.random.key(config.seed), state.step)


def adam(params: SceneParams, rates: dict[str, optimizer.Schedule], config: Config) -> optimizer.Transformation:
    """The optimizer of all of `params`."""
    return optimizer.adam(groups(params), rates, config.optim.beta1, config.optim.beta2, config.optim.eps)


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
    """Change the number of Gaussians; also how many rows that needs, to be called again with if there are fewer.

    Args:
        state: after a step.
        config: settings.
        growths_left: how often the stage grows from now on, this time included.
    """
    scene, cfg, key = state.scene, config.density, _key(state, config)
    if cfg.method == "mcmc":
        count = relocation.population(scene.alive.sum(), densification.most_gaussians(cfg), growths_left)
        own = jax.random.fold_in(key, 0)
        result = relocation.relocate(scene.params.gaussians, scene.alive, count, own, cfg.prune_opacity)
    else:
        result = densification.densify(scene.params.gaussians, scene.alive, state.stats, scene.extent, key, cfg)

    def forget(rows: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.where(result.changed.reshape(-1, *[1] * (rows.ndim - 1)), 0, rows)

    grown = TrainState(
        scene=scene._replace(params=scene.params._replace(gaussians=result.gaussians), alive=result.alive),
        adam=state.adam._replace(mu=_map_gaussians(forget, state.adam.mu), nu=_map_gaussians(forget, state.adam.nu)),
        stats=jax.tree.map(jnp.zeros_like, state.stats),
        step=state.step,
    )
    return grown, jnp.where(result.missing > 0, scene.alive.sum() + result.wanted, 0)


def with_capacity(state: TrainState, capacity: int) -> TrainState:
    """The same state with dead rows appended up to `capacity`."""
    pad = partial(pad_rows, capacity=capacity)
    return TrainState(
        scene=state.scene._replace(params=_map_gaussians(pad, state.scene.params), alive=pad(state.scene.alive)),
        adam=state.adam._replace(mu=_map_gaussians(pad, state.adam.mu), nu=_map_gaussians(pad, state.adam.nu)),
        stats=jax.tree.map(pad, state.stats),
        step=state.step,
    )


def tree_where(condition: Bool[Array, ""], new: T, old: T) -> T:
    """One tree or the other."""
    return jax.tree.map(lambda new, old: jnp.where(condition, new, old), new, old)


def _map_gaussians(function: Callable[[Array], Array], params: SceneParams) -> SceneParams:
    """`params`, or moments of them, with a function applied to every array of the Gaussians."""
    return params._replace(gaussians=jax.tree.map(function, params.gaussians))


def _mean(tree: T, axis: str | None) -> T:
    return tree if axis is None else jax.lax.pmean(tree, axis)


def _max(x: Array, axis: str | None) -> Array:
    return x if axis is None else jax.lax.pmax(x, axis)
