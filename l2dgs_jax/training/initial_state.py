"""The state that a training starts from."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from l2dgs_jax.cameras.flow import check_size
from l2dgs_jax.cameras.geometry import median_depth
from l2dgs_jax.cameras.ground import FLOW_TOLERANCE, TOLERANCE
from l2dgs_jax.config import Config, ModelConfig, overrides
from l2dgs_jax.data.dataset import Dataset, Split
from l2dgs_jax.errors import UserError
from l2dgs_jax.model import networks
from l2dgs_jax.model.initialisation import initialise, path_knots, scene_shapes, spread_over, z_order
from l2dgs_jax.model.observation import evenly_exposed, exposures, observed_colors
from l2dgs_jax.model.tone import Darkening, darkening, lit_level, recognise
from l2dgs_jax.model.tone_curves import equalising_law, power_law
from l2dgs_jax.runtime.capacity import next_capacity
from l2dgs_jax.training.seeds import find_seeds
from l2dgs_jax.training.state import TrainState
from l2dgs_jax.training.step import begin_stage
from l2dgs_jax.training.surfaces import find_surfaces, thinned

GAUSSIANS_PER_PIXEL = (0.6, 1.5)  # of a frame: least and greatest, in between in proportion to the number of views
VIEWS_PER_GAUSSIAN = 28  # needed for one Gaussian per pixel: with fewer views, as many Gaussians would fit noise
MAX_GAUSSIANS = 360_000  # however large the frames
MIN_SURFACE_POINTS = 500  # that random points give way to
SPARSE_POINTS = 4000  # about as many as structure from motion finds, taken of those where there is no cloud
EXPOSURE_DRIFT = 0.05  # standard deviation of the frames' log gains above which exposure counts as drifting


def split_darkening(split: Split, config: Config) -> Darkening:
    """The power law that darkens images of level `config.loss.exposure_level` to the frames.

    With tone curves it darkens images of flat histograms instead; where low light is not modelled it changes nothing.
    """
    if config.model.decomposition == "none":
        return Darkening(1.0, 1.0)
    if config.model.decomposition == "curve":
        return equalising_law(split.images, split.valid)
    model, level = config.model, float(config.loss.exposure_level)
    assert model.tone != "auto", "expected settings that are resolved"
    return darkening(split.mean_level, level, model.tone, of_light=model.domain == "light")


def resolve(config: Config, dataset: Dataset) -> Config:
    """The settings with what they leave to the data ("auto") determined from points and training frames.

    Raises:
        UserError: the frames show nothing or are too small, or the points are behind all cameras.
    """
    split = dataset.train
    if config.model.tracks or config.model.surfaces or config.inbetweens:
        try:
            check_size(dataset.height, dataset.width)
        except UserError as error:
            raise UserError(f"{dataset.name}: {error}, so a smaller --downscale") from None
    counted = split.valid is None or any(frame.any() for frame in split.valid)
    if not counted or split.mean_level == 0:
        raise UserError(
            f"{dataset.name}: all its training frames are black or transparent; expected frames that show something"
        )
    try:
        median_depth(split.cameras, dataset.points)
    except ValueError as error:
        raise UserError(
            f"{dataset.name}: {error}; expected poses that face its points: they may be in another axis convention"
        ) from None
    instants = len(np.unique(split.cameras.time))
    if config.model.time_size is None and instants < len(split.names):  # several cameras
        config = overrides.replace(config, {"model.time_size": max(instants // 2, 2)})
    if config.density.max_gaussians == "auto":
        config = overrides.replace(config, {"density.max_gaussians": _max_gaussians(split)})
    if config.model.exposure == "auto":
        drift = exposures(dataset.points, split.cameras, split.images, split.valid).std(0).max() > EXPOSURE_DRIFT
        config = overrides.replace(config, {"model.exposure": "drifting" if drift else "steady"})
    if config.model.tone == "auto":
        config = overrides.replace(config, {"model.tone": recognise(split.images, split.valid)})
    if config.model.domain == "auto":
        domain = "light" if config.model.tone == "linear-light" else "values"
        config = overrides.replace(config, {"model.domain": domain})
    model = config.model
    if config.loss.exposure_level == "auto":
        level = lit_level(split.images, split.valid, split.mean_level, of_light=model.domain == "light")
        config = overrides.replace(config, {"loss.exposure_level": round(level, 3)})
    if "auto" not in (*(model.initial_exponents or ()), model.initial_illumination):
        return config
    exponent, gain, _ = split_darkening(split, config)
    if model.decomposition != "retinex":
        model = dataclasses.replace(model, initial_exponents=None)  # there are no B1 and B2
    if model.initial_exponents and model.initial_exponents[0] == "auto":
        model = dataclasses.replace(model, initial_exponents=(exponent, model.initial_exponents[1]))
    if model.initial_illumination == "auto":
        illumination = float(f"{gain ** (1 / _light_exponent(model)):.3g}")
        model = dataclasses.replace(model, initial_illumination=illumination)
    return dataclasses.replace(config, model=model)


def _light_exponent(model: ModelConfig) -> float:
    """B2 at the start."""
    if model.unit_exponent == "b2":
        return 1.0
    return float(model.initial_exponents[1]) if model.initial_exponents else networks.EXPONENT_CENTRE


def _max_gaussians(split: Split) -> int:
    views, height, width = split.images.shape[:3]
    per_pixel = np.clip(views / VIEWS_PER_GAUSSIAN, *GAUSSIANS_PER_PIXEL)
    return min(round(per_pixel * height * width), MAX_GAUSSIANS)


def initial_state(dataset: Dataset, config: Config) -> TrainState:
    """The state before the first step of a `resolve`d config; the same seed and data give the same state.

    Of more points than there may be Gaussians, as many are used, as densely where they are dense. Random points give
    way to what `find_surfaces` finds, if that is enough.
    """
    train, most = dataset.train, int(config.density.max_gaussians)
    colors = dataset.colors if config.model.initial_illumination is None else None  # what they are needed for
    sparse, points, tolerance = dataset.points, dataset.points, TOLERANCE
    if len(points) > most:
        kept = spread_over(points, most)
        points, colors = points[kept], None if colors is None else colors[kept]
    gains, even = None, train
    if config.model.exposure == "drifting":
        gains = exposures(points, train.cameras, train.images, train.valid)
        even = dataclasses.replace(train, images=evenly_exposed(train.images, gains))
    if config.model.surfaces and dataset.points_are_random:
        found = find_surfaces(points, even, most=most, random=True)
        if len(found) >= MIN_SURFACE_POINTS:
            sparse, points, tolerance = thinned(found, SPARSE_POINTS), found, FLOW_TOLERANCE
    elif config.model.surfaces:
        found = find_surfaces(points, even, most=most - len(points))
        if colors is not None:
            colors = np.concatenate([colors, observed_colors(found, train.cameras, train.images, train.valid)])
        points = np.concatenate([points, found])
    order = z_order(points)
    points, colors = points[order], None if colors is None else colors[order]
    seeds = None
    if config.model.tracks:
        # Not all points: the nearest ones of so many are too near to give the depth of what moves.
        knots = path_knots(config.model, len(train.names))
        seeds = find_seeds(sparse, even, knots, min(_max_gaussians(train), most), tolerance)
    capacity = len(points) + (0 if seeds is None else len(seeds.points))
    if config.density.start < config.density.stop:
        limit = max(most, capacity)
        capacity = limit if config.density.method == "mcmc" else next_capacity(min(1.5 * capacity, limit))
    reflectance = light = None
    if config.model.reflectance_init == "observed":
        law = split_darkening(train, config)
        observed = observed_colors(points, train.cameras, train.images, train.valid)
        if seeds is not None:
            observed = np.concatenate([observed, seeds.colors])
        reflectance, light = law.undone(observed)
        light = light ** (1 / _light_exponent(config.model))
    key = jax.random.key(config.seed)
    curve = power_law(split_darkening(train, config)) if config.model.decomposition == "curve" else None
    scene = initialise(
        key, points, colors, train.cameras, config.model, capacity, reflectance, light, gains, seeds, curve
    )
    return _begin_stage(scene, jnp.zeros((), jnp.int32), config, config.coarse_steps)


def state_shapes(config: Config, num_frames: int) -> TrainState:
    """Shapes and types of a training's states, except that the number of Gaussians is 1; nothing is computed.

    Args:
        config: its settings.
        num_frames: training frames of its scene.
    """
    scene = scene_shapes(config.model, num_frames)
    return jax.eval_shape(
        lambda scene: begin_stage(scene, jnp.zeros((), jnp.int32), config, config.coarse_steps), scene
    )


_begin_stage = jax.jit(begin_stage, static_argnames=("config", "stage_steps"))
