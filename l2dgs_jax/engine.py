"""The training step and the coarse-to-fine loop. No input or output: callers consume the steps that `run` yields."""

import dataclasses
import warnings
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax import density, hexplane, losses, networks, optim
from l2dgs_jax.config import Config
from l2dgs_jax.data.batching import view_indices
from l2dgs_jax.data.dataset import Dataset, Split
from l2dgs_jax.data.stacks import pixel_mean
from l2dgs_jax.density import GrowthStats
from l2dgs_jax.rasterizer import count_pairs
from l2dgs_jax.rendering import render
from l2dgs_jax.scene import groups, initialise, observed_colors, pad_rows, rung
from l2dgs_jax.tone import Darkening, darkening
from l2dgs_jax.types import Camera, Scene, SceneParams

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # jaxopt announces that it is unmaintained
    from jaxopt import OptaxSolver
    from jaxopt._src.optax_wrapper import OptaxState


MARGIN = 1.3  # of the pair buffer over what was last needed: every size is a compilation


class Batch(NamedTuple):
    """The views of one step; images are sRGB in [0, 1], and nothing is learned where they are not `valid`."""

    cameras: Camera
    images: Float[Array, "*S V H W 3"]
    valid: Bool[Array, "*S V H W"] | None = None


class TrainState(NamedTuple):
    """All that a step reads and writes, and all that a checkpoint holds. `step` counts finished steps."""

    scene: Scene
    adam: optim.AdamState
    stats: GrowthStats
    step: Int[Array, "*S"]


class StepReport(NamedTuple):
    """What a step found. The state is unchanged if the pair buffer overflowed or a gradient was not finite.

    Attributes:
        loss: Eq. 15 plus the plane regularisers.
        terms: each term, unweighted.
        psnr: of the low-light estimate against the input, dB, before the step.
        pairs: (Gaussian, tile) pairs that the step needs.
        overflow: whether they did not fit.
        finite: whether loss and gradient are.
    """

    loss: Float[Array, "*S"]
    terms: dict[str, Float[Array, "*S"]]
    psnr: Float[Array, "*S"]
    pairs: Int[Array, "*S"]
    overflow: Bool[Array, "*S"]
    finite: Bool[Array, "*S"]


class Progress(NamedTuple):
    """One finished step, as `run` yields it. `state` is valid until the next step is asked for."""

    state: TrainState
    report: StepReport
    pair_capacity: int


class DivergedError(ArithmeticError):
    """The loss or a gradient is not finite."""


def sh_degree(step: Int[Array, ""] | int, config: Config) -> Int[Array, ""] | int:
    """SH bands in use after `step` steps: one more every `config.sh_warmup`."""
    return jnp.minimum(step // max(config.sh_warmup, 1), config.model.sh_degree)


def exponent_target(config: Config) -> float:
    """Where the prior of `config.loss.exponent_prior` pulls B1: its start, or 1 if that is left to chance."""
    start = config.model.initial_exponents
    return float(start[0]) if start else 1.0


def objective(
    params: SceneParams,
    probe: Float[Array, "V N 2"],
    state: TrainState,
    batch: Batch,
    config: Config,
    moving: bool,
    pair_capacity: int,
) -> tuple[Float[Array, ""], tuple[StepReport, Float[Array, "V N"]]]:
    """Eq. 15 plus the plane regularisers of 4DGS (arXiv 2310.08528), for one batch.

    Gradients flow to `params` and to `probe`, zeros added to the projected centres.

    Returns:
        The loss, and (the report, the Gaussians' radii in every view).
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
    )
    cfg = config.loss
    start, steps = (config.coarse_steps, config.fine_steps) if moving else (0, config.coarse_steps)
    eta = losses.eta(state.step - start, steps, cfg) if cfg.eta_restarts else losses.eta(state.step, config.steps, cfg)
    target, counted = targets(batch, output.images.lowlight)
    loss, terms = losses.total(output, target, cfg, eta, exponent_target(config))
    if moving:
        smoothness, time_smoothness, time_l1 = hexplane.regularisers(params.hexplane)
        loss += cfg.plane_smoothness * smoothness + cfg.time_smoothness * time_smoothness + cfg.time_l1 * time_l1
    mse = jnp.mean(jnp.square(output.images.lowlight - target)) / counted
    report = StepReport(loss, terms, -10 * jnp.log10(mse), output.pairs, output.overflow, jnp.isfinite(loss))
    return loss, (report, output.radii)


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


@partial(jax.jit, static_argnames=("config", "moving", "pair_capacity"), donate_argnums=0)
def train_step(
    state: TrainState, batch: Batch, config: Config, *, moving: bool, pair_capacity: int
) -> tuple[TrainState, StepReport]:
    """One Adam step on one batch; a step that cannot be trusted leaves the state as it was and says so."""
    batch = jax.tree.map(lambda x: x if x.dtype == bool else x.astype(state.stats.seen.dtype), batch)

    def value_and_grad(params: SceneParams) -> tuple:
        probe = jnp.zeros((*batch.cameras.time.shape, state.scene.alive.shape[0], 2), batch.images.dtype)
        (loss, (report, radii)), (gradient, probe_gradient) = jax.value_and_grad(objective, (0, 1), has_aux=True)(
            params, probe, state, batch, config, moving, pair_capacity
        )
        return (loss, (report, radii, probe_gradient)), gradient

    transformation = adam(state.scene.params, state.adam.schedules, config)
    solver = OptaxSolver(value_and_grad, transformation, value_and_grad=True, has_aux=True, jit=False)
    zero = jnp.zeros((), batch.images.dtype)
    before = OptaxState(iter_num=state.step, value=zero, error=zero, internal_state=state.adam, aux=None)
    params, after = solver.update(state.scene.params, before)
    report, radii, probe_gradient = after.aux

    height, width = batch.images.shape[1:3]
    report = report._replace(finite=report.finite & jnp.isfinite(after.error))
    stepped = TrainState(
        scene=state.scene._replace(params=params),
        adam=after.internal_state,
        stats=density.accumulate(state.stats, probe_gradient, radii, width, height),
        step=state.step + 1,
    )
    trusted = report.finite & ~report.overflow
    return jax.tree.map(lambda new, old: jnp.where(trusted, new, old), stepped, state), report


def adam(params: SceneParams, rates: dict[str, optim.Schedule], config: Config) -> optim.Transformation:
    """The optimizer of all of `params`."""
    return optim.adam(groups(params), rates, config.optim.beta1, config.optim.beta2, config.optim.eps)


def split_darkening(split: Split, config: Config) -> Darkening:
    """How the frames are darker than `config.loss.exposure_level`."""
    level = np.mean(pixel_mean(split.images, split.valid))
    return darkening(float(level), config.loss.exposure_level)


def resolve(config: Config, split: Split) -> Config:
    """The settings with what they leave to the data filled in from the training frames."""
    model = config.model
    exponent, gain = split_darkening(split, config)
    if model.initial_exponents and model.initial_exponents[0] == "auto":
        model = dataclasses.replace(model, initial_exponents=(round(exponent, 3), model.initial_exponents[1]))
    if model.initial_illumination == "auto":
        b2 = model.initial_exponents[1] if model.initial_exponents else networks.EXPONENT_CENTRE
        model = dataclasses.replace(model, initial_illumination=round(gain ** (1 / b2), 3))
    return dataclasses.replace(config, model=model)


def initial_state(dataset: Dataset, config: Config) -> TrainState:
    """The state before the first step of a `resolve`d config; the same seed and data give the same state."""
    points, train = dataset.points, dataset.train
    capacity = len(points)
    if config.density.start < config.density.stop:
        capacity = rung(min(1.5 * capacity, max(config.density.max_gaussians, capacity)))
    reflectance = None
    if config.model.reflectance_init == "observed":
        law = split_darkening(train, config)
        observed = observed_colors(points, train.cameras, train.images, train.valid)
        reflectance = (observed / law.gain) ** (1 / law.exponent)
    scene = initialise(
        jax.random.key(config.seed), points, dataset.colors, train.cameras, config.model, capacity, reflectance
    )
    return begin_stage(scene, jnp.zeros((), jnp.int32), config, config.coarse_steps)


@partial(jax.jit, static_argnames=("config", "stage_steps"))
def begin_stage(scene: Scene, step: Int[Array, ""], config: Config, stage_steps: int) -> TrainState:
    """A state with fresh optimizer moments, schedules and statistics, as 4DGS starts each stage."""
    rates = optim.schedules(config.optim, scene.extent, stage_steps)
    transformation = adam(scene.params, rates, config)
    return TrainState(scene, transformation.init(scene.params), density.empty_stats(scene.alive.shape[0]), step)


def run(split: Split, config: Config, state: TrainState, pair_capacity: int | None = None) -> Iterator[Progress]:
    """Train from `state` to the end, coarse stage then fine, yielding after every step.

    Args:
        split: training views.
        config: settings.
        state: from `initial_state` or a checkpoint; its buffers are given up.
        pair_capacity: size of the pair buffer to start with, as a checkpoint holds it.

    Raises:
        DivergedError: loss or gradient of a step are not finite.
    """
    pair_capacity = pair_capacity or first_capacity(split, config, state.scene)
    for step in range(int(state.step), config.steps):
        moving = step >= config.coarse_steps
        stage_start = config.coarse_steps if moving else 0
        if moving and step == stage_start:
            state = begin_stage(state.scene, state.step, config, config.fine_steps)

        batch = load_batch(split, view_indices(config.seed, step, config.batch_size, len(split.names)))
        while True:
            state, report = train_step(state, batch, config, moving=moving, pair_capacity=pair_capacity)
            if not report.overflow:
                break
            pair_capacity = rung(MARGIN * float(report.pairs))
        if not report.finite:
            terms = ", ".join(f"{name} {float(value):.3g}" for name, value in report.terms.items())
            raise DivergedError(f"the loss or its gradient is not finite at step {step} ({terms})")

        if density_due(step + 1 - stage_start, config):
            state = densify(state, config)
        yield Progress(state, report, pair_capacity)


def first_capacity(split: Split, config: Config, scene: Scene) -> int:
    """A pair buffer for a batch of the first views, their Gaussians at rest, with a margin for the others."""
    gaussians = scene.params.gaussians
    batch = load_batch(split, np.arange(config.batch_size) % len(split.names))
    cameras = jax.tree.map(lambda x: jnp.asarray(x, gaussians.means.dtype), batch.cameras)
    height, width = split.images.shape[1:3]
    opacities = jnp.where(scene.alive, jax.nn.sigmoid(gaussians.logit_opacities), 0)
    rows = (gaussians.means, gaussians.quats, jnp.exp(gaussians.log_scales), opacities)
    per_view = (jnp.broadcast_to(x[None], (config.batch_size, *x.shape)) for x in rows)
    return rung(MARGIN * float(count_pairs(*per_view, cameras.viewmat, cameras.K, width, height)))


def load_batch(split: Split, indices: Int[np.ndarray, " V"]) -> Batch:
    """The views of `indices`."""
    valid = None if split.valid is None else split.valid[indices]
    return Batch(Camera(*(x[indices] for x in split.cameras)), split.images[indices], valid)


def density_due(stage_step: int, config: Config) -> bool:
    """Whether the stage's step of that number is followed by densification."""
    cfg = config.density
    return cfg.start < stage_step < cfg.stop and stage_step % cfg.interval == 0


def densify(state: TrainState, config: Config) -> TrainState:
    """Clone, split and prune, moving up the capacity ladder when rows run out."""
    while True:
        grown, missing, wanted = _densify(state, config)
        if not missing:
            return grown
        state = with_capacity(state, rung(int(state.scene.alive.sum()) + int(wanted)))


@partial(jax.jit, static_argnames="config")
def _densify(state: TrainState, config: Config) -> tuple[TrainState, Int[Array, ""], Int[Array, ""]]:
    scene = state.scene
    key = jax.random.fold_in(jax.random.key(config.seed), state.step)
    result = density.densify(scene.params.gaussians, scene.alive, state.stats, scene.extent, key, config.density)
    forget = lambda rows: jnp.where(result.changed.reshape(-1, *[1] * (rows.ndim - 1)), 0, rows)
    moments = lambda tree: tree._replace(gaussians=jax.tree.map(forget, tree.gaussians))
    grown = TrainState(
        scene=scene._replace(params=scene.params._replace(gaussians=result.gaussians), alive=result.alive),
        adam=state.adam._replace(mu=moments(state.adam.mu), nu=moments(state.adam.nu)),
        stats=jax.tree.map(jnp.zeros_like, state.stats),
        step=state.step,
    )
    return grown, result.missing, result.wanted


def with_capacity(state: TrainState, capacity: int) -> TrainState:
    """The same state with dead rows appended up to `capacity`."""
    grow = lambda tree: tree._replace(gaussians=jax.tree.map(lambda x: pad_rows(x, capacity), tree.gaussians))
    return TrainState(
        scene=state.scene._replace(params=grow(state.scene.params), alive=pad_rows(state.scene.alive, capacity)),
        adam=state.adam._replace(mu=grow(state.adam.mu), nu=grow(state.adam.nu)),
        stats=jax.tree.map(lambda x: pad_rows(x, capacity), state.stats),
        step=state.step,
    )
