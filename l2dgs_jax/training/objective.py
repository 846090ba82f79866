"""What a training step minimises: Eq. 15, the regularisers of 4DGS, and what `LossConfig` adds."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.config import Config, LossConfig
from l2dgs_jax.data.dataset import SATURATED
from l2dgs_jax.model import hexplane, tone_curves
from l2dgs_jax.model.deformation import length_unit
from l2dgs_jax.model.rendering import render
from l2dgs_jax.runtime import devices
from l2dgs_jax.training import losses
from l2dgs_jax.training.given_depth import depth_disagreement
from l2dgs_jax.training.rigidity import rigidity
from l2dgs_jax.training.state import Batch, StepReport, TrainState, randomness
from l2dgs_jax.types import Scene, SceneParams, ToneCurves


def sh_degree(step: Int[Array, ""] | int, config: Config) -> Int[Array, ""] | int:
    """SH bands in use after `step` steps: one more every `config.sh_warmup`."""
    warmup = config.steps // (2 * max(config.model.sh_degree, 1)) if config.sh_warmup is None else config.sh_warmup
    return jnp.minimum(step // max(warmup, 1), config.model.sh_degree)


def exponent_target(config: Config) -> float | Float[Array, ""]:
    """Where the prior of `config.loss.exponent_prior` pulls B1: to its initial value, or to 1 if none is set."""
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

    Gradients flow to `params` and to `probe`. The loss is that of the views given: if views are spread over the devices
    of `axis`, its mean over the devices is the loss of all views.

    Args:
        params: of the scene, in place of those that `state` holds.
        probe: zeros, added to the projected centres, pixels.
        state: the scene, and which step this is.
        batch: V views.
        config: settings.
        moving: whether it is a step of the fine stage.
        pair_capacity: size of the pair buffer for the views given.
        axis: see `train_step`.

    Returns:
        The loss, and (the report, the Gaussians' radii in every view, pixels).
    """
    height, width = batch.images.shape[1:3]
    scene = state.scene._replace(params=params)
    output = render(
        scene,
        batch.cameras,
        config.model,
        width,
        height,
        moving=moving,
        sh_degree=sh_degree(state.step, config),
        pair_capacity=pair_capacity,
        means2d_probe=probe,
        presence=presence(state, config),
    )
    cfg = config.loss
    start, steps = (config.coarse_steps, config.fine_steps) if moving else (0, config.coarse_steps)
    eta = losses.eta(state.step - start, steps, cfg) if cfg.eta_restarts else losses.eta(state.step, config.steps, cfg)
    images = output.images
    if params.curves is not None:
        own = tone_curves.of_frames(params.curves, batch.frames)
        images = images._replace(lowlight=tone_curves.darkened(images.welllit, own))
    images = images._replace(lowlight=exposed(images.lowlight, params.exposures, batch.frames))
    lowlight, target, counted = compared(batch, images.lowlight)
    images = images._replace(lowlight=lowlight)
    measured = output._replace(images=images, depth=output.depth / length_unit(state.scene.extent, config.model))
    loss, terms = losses.total(measured, target, cfg, eta, exponent_target(config), controlled(batch))
    others = size_terms(scene, config, moving) | curve_terms(params.curves, batch, cfg)
    if moving:
        smoothness, time_smoothness, time_l1 = hexplane.regularisers(params.hexplane)
        loss += cfg.plane_smoothness * smoothness + cfg.time_smoothness * time_smoothness + cfg.time_l1 * time_l1
        key = jax.random.fold_in(randomness(state, config), 5)
        others["rigidity"] = (cfg.rigidity, lambda: rigidity(scene, config.model, key))
    if batch.depths is not None:
        depths = batch.depths
        others["depth_input"] = (cfg.depth_input, lambda: depth_disagreement(output.depth, output.alpha, depths))
    other, values = losses.weighted_sum(others)
    loss, terms = loss + other, terms | values
    squares = jnp.mean(jnp.square(jax.lax.stop_gradient(lowlight) - target))
    mse = devices.mean_over(squares, axis) / devices.mean_over(counted, axis)
    report = StepReport(loss, terms, -10 * jnp.log10(mse), output.pairs, output.overflow, jnp.isfinite(loss))
    return loss, (report, output.radii)


def size_terms(scene: Scene, config: Config, moving: bool) -> losses.Terms:
    """Weight and value of the terms that keep Gaussians few, small and static: means over those that are alive."""
    gaussians, alive, cfg = scene.params.gaussians, scene.alive, config.loss

    def mean(values: Float[Array, " N"]) -> Float[Array, ""]:
        return jnp.where(alive, values, 0).sum() / jnp.maximum(alive.sum(), 1).astype(values.dtype)

    def scale() -> Float[Array, ""]:
        # Dead rows may hold any values: if exp overflowed on one, its gradient would be 0 * inf = NaN.
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
    """Weight and value of the priors on the shape of the frames' tone curves."""
    if curves is None:
        return {}
    own = tone_curves.of_frames(curves, batch.frames)
    return {
        "equalisation": (cfg.equalisation, lambda: tone_curves.equalisation(own, batch.images, batch.valid)),
        "bend": (cfg.bend, lambda: tone_curves.bend(own)),
    }


def presence(state: TrainState, config: Config) -> Float[Array, " N"] | None:
    """Factors on the opacities in this step: 0 for Gaussians that are dropped (DropGaussian, arXiv 2504.09491).

    Their share grows linearly up to `config.drop` at the end of the run; the factor of the others compensates for it.
    """
    if isinstance(config.drop, float) and config.drop == 0:
        return None
    share = config.drop * state.step.astype(state.stats.seen.dtype) / config.steps
    key = jax.random.fold_in(randomness(state, config), 3)
    return jnp.where(jax.random.bernoulli(key, share, state.scene.alive.shape), 0, 1 / (1 - share))


def exposed(
    lowlight: Float[Array, "V H W 3"], exposures: Float[Array, "F 3"] | None, frames: Int[Array, " V"]
) -> Float[Array, "V H W 3"]:
    """Low-light estimates with the exposure of their training frames; `lowlight` and `exposures` carry gradients.

    Gains count relative to their geometric mean over the frames, which the scene's own brightness accounts for.
    """
    if exposures is None:
        return lowlight
    return lowlight * jnp.exp(exposures - exposures.mean(0, keepdims=True))[frames][:, None, None]


def controlled(batch: Batch) -> Bool[Array, "V H W"]:
    """Pixels whose brightness counts for exposure control: those that `Split.mean_level` counts too."""
    unsaturated = batch.images.max(-1) < SATURATED
    return unsaturated if batch.valid is None else unsaturated & batch.valid


def compared(
    batch: Batch, estimate: Float[Array, "V H W 3"]
) -> tuple[Float[Array, "V H W 3"], Float[Array, "V H W 3"], Float[Array, ""] | float]:
    """The low-light estimate, what it is compared with, and the share of pixels that count.

    Where pixels are not valid, both are the estimate, held constant: nothing can be learned there.
    """
    if batch.valid is None:
        return estimate, batch.images, 1.0
    valid, constant = batch.valid[..., None], jax.lax.stop_gradient(estimate)
    share = jnp.maximum(batch.valid.mean(dtype=estimate.dtype), 1e-6)
    return jnp.where(valid, estimate, constant), jnp.where(valid, batch.images, constant), share
