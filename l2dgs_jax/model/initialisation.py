"""The scene that a training starts from: one Gaussian per point."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, Shaped
from scipy.spatial import cKDTree
from scipy.special import logit

from l2dgs_jax.cameras.geometry import camera_extent, median_depth
from l2dgs_jax.config import ModelConfig
from l2dgs_jax.data.stacks import evenly_spread
from l2dgs_jax.model import hexplane, networks
from l2dgs_jax.model.deformation import has_path, length_unit
from l2dgs_jax.model.tone_curves import RAMPS
from l2dgs_jax.runtime.capacity import next_capacity
from l2dgs_jax.types import Camera, Gaussians, Scene, SceneParams, ToneCurves

SH_DC = 0.28209479177387814  # value of the first SH basis function
LUMINANCE = np.array([0.2989, 0.587, 0.114])
MAX_ILLUMINATION = 0.999  # that a lamp starts with: beyond 1 there is no gradient
INITIAL_GATE = 2.0  # logit of the factor on motion that every Gaussian starts with
EXTENT_PER_DEPTH = 0.25  # extent over median depth: about the radius of a hand-held camera's path
MIN_SCALE = 1e-7**0.5  # lower bound on initial scales, in units of length (as 3DGS)
SEED_SCALE = 0.6  # initial scale of seeds over their spacing
MAX_KNOTS = 100  # control points of a path


class Seeds(NamedTuple):
    """S points on moving things to start Gaussians with paths from.

    Attributes:
        points: canonical centres of the Gaussians, world units.
        colors: in the dark frames, sRGB in [0, 1].
        spacings: how far they are from each other, world units.
        paths: as in `SceneParams`.
        lifetimes: as in `Gaussians`.
    """

    points: Float[np.ndarray, "S 3"]
    colors: Float[np.ndarray, "S 3"]
    spacings: Float[np.ndarray, " S"]
    paths: Float[np.ndarray, "S K 3"]
    lifetimes: Float[np.ndarray, "S 2"]


def path_knots(cfg: ModelConfig, num_frames: int) -> int:
    """Control points of a path: as the motion field has cells in time, but 4 to `MAX_KNOTS` or half the frames."""
    return min(max(min(hexplane.time_cells(cfg, num_frames), num_frames // 2), 4), MAX_KNOTS)


def z_order(points: np.ndarray) -> np.ndarray:
    """The order of points [P 3] along a Z-order curve (Morton, 1966).

    What lies close in space then mostly lies close in memory, so that feature lookups hit the caches.
    """
    bits = 10
    low, span = points.min(0), max(float(np.ptp(points, axis=0).max()), 1e-30)
    cells = ((points - low) / span * (2**bits - 1)).astype(np.int64)
    interleaved = (((cells[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(bits) for axis in range(3))
    return np.argsort(sum(interleaved), kind="stable")


def spread_over(points: np.ndarray, most: int) -> np.ndarray:
    """Indices of at most so many of the points [P 3], as densely where they are dense."""
    return z_order(points)[evenly_spread(len(points), most)]


def initialise(
    key: PRNGKeyArray,
    points: np.ndarray,
    colors: np.ndarray | None,
    cameras: Camera,
    cfg: ModelConfig,
    capacity: int,
    reflectance: np.ndarray | None = None,
    light: np.ndarray | None = None,
    exposures: np.ndarray | None = None,
    seeds: Seeds | None = None,
    curve: np.ndarray | None = None,
) -> Scene:
    """A scene with one Gaussian per point, followed by one per seed, ready for training.

    Scales are the root mean square distance to the three nearest points, illumination the luminance of the point
    (mid-grey without colours) unless `cfg.initial_illumination` says otherwise, opacity `cfg.initial_opacity`,
    attenuation random, and so is reflectance unless it is given (paper, section 4).

    Args:
        key: randomness of reflectance, attenuation, planes and networks.
        points: [P 3] world units.
        colors: [P 3] sRGB in [0, 1], or None.
        cameras: the training cameras, [F]; their number sets the time resolution.
        cfg: shape and initial state.
        capacity: rows to allocate; those past P + S are dead.
        reflectance: [P + S 3] initial reflectance, for `cfg.reflectance_init` "observed".
        light: [P + S] factors on `cfg.initial_illumination`, above 1 for what is too bright for any reflectance.
        exposures: [F 3] logarithms of the frames' gains to start from, for `cfg.exposure` "drifting".
        seeds: S of them, for `cfg.tracks`.
        curve: [R] what all frames' tone curves start from, for `cfg.decomposition` "curve".
    """
    distances, _ = cKDTree(points).query(points, k=min(4, len(points)))
    mean_square = np.square(distances[:, 1:]).mean(-1) if len(points) > 1 else np.ones(1)
    extent = camera_extent(cameras) if cfg.unit == "world" else EXTENT_PER_DEPTH * median_depth(cameras, points)
    paths = lifetimes = None
    if seeds is not None:
        num_static = len(points)
        unused = next_capacity(len(seeds.paths)) - len(seeds.paths)  # scenes of like sizes share compiled programs
        paths = np.pad(seeds.paths, [(0, unused), (0, 0), (0, 0)])
        lifetimes = np.concatenate([np.tile([[-np.inf, np.inf]], (num_static, 1)), seeds.lifetimes])
        mean_square = np.concatenate([mean_square, np.square(SEED_SCALE * seeds.spacings)])
        points = np.concatenate([points, seeds.points])
        colors = None if colors is None else np.concatenate([colors, seeds.colors])
    count = len(points)
    if cfg.initial_illumination is not None:
        illumination = np.full(count, cfg.initial_illumination)
        if light is not None:
            illumination = np.minimum(illumination * light, MAX_ILLUMINATION)
    else:
        illumination = np.full(count, 0.5) if colors is None else np.asarray(colors) @ LUMINANCE
    bias = None if cfg.initial_exponents is None else networks.exponent_bias(cfg.initial_exponents)
    min_scale = MIN_SCALE * length_unit(extent, cfg)
    rim = (1 - cfg.box_points) / 2
    given: dict[str, np.ndarray | float | None] = {
        "points": points,
        "bounds": np.quantile(points, [rim, 1 - rim], axis=0),
        "log_scales": np.log(np.maximum(np.sqrt(mean_square), min_scale)),
        "illumination": illumination - cfg.illumination_offset,
        "logit_opacities": np.full(count, logit(cfg.initial_opacity)),
        "extent": extent,
        "reflectance": reflectance,
        "exponent_bias": bias,
        "exposures": exposures,
        "curve": curve,
        "paths": paths,
        "lifetimes": lifetimes,
    }
    start: dict[str, Any] = {name: None if x is None else jnp.asarray(x, float) for name, x in given.items()}
    settings, num_frames = _static_settings(cfg), len(cameras.time)
    return _initialise(key, _Start(**start), cfg=settings, num_frames=num_frames, capacity=capacity)


def scene_shapes(cfg: ModelConfig, num_frames: int) -> Scene:
    """Shapes and types of a scene of one Gaussian; nothing is computed.

    Args:
        cfg: shape of the scene.
        num_frames: training frames.
    """
    array: Any = lambda *shape: jax.ShapeDtypeStruct(shape, jnp.zeros(()).dtype)
    start = _Start(
        points=array(1, 3),
        bounds=array(2, 3),
        log_scales=array(1),
        illumination=array(1),
        logit_opacities=array(1),
        extent=array(),
        reflectance=array(1, 3),
        exponent_bias=array(2),
        exposures=array(num_frames, 3),
        curve=array(RAMPS),
        paths=array(1, path_knots(cfg, num_frames), 3) if cfg.tracks else None,
        lifetimes=array(1, 2) if cfg.tracks else None,
    )
    build = partial(_initialise, cfg=_static_settings(cfg), num_frames=num_frames, capacity=1)
    return jax.eval_shape(build, jax.eval_shape(lambda: jax.random.key(0)), start)


def _static_settings(cfg: ModelConfig) -> ModelConfig:
    """The settings without mere initial values: scenes that differ only in these share a compiled program."""
    default = ModelConfig()
    return dataclasses.replace(
        cfg,
        box_points=default.box_points,
        illumination_offset=default.illumination_offset,
        initial_exponents=None,
        initial_illumination=None,
        initial_opacity=default.initial_opacity,
    )


class _Start(NamedTuple):
    """Arrays that a scene of P Gaussians starts from; see `initialise`.

    Attributes:
        points: centres, world units.
        bounds: of the HexPlane's box.
        log_scales: logarithms of scales, world units.
        illumination: what the spherical harmonics are to give, without their offset.
        logit_opacities: logits of opacities.
        extent: see `Scene`.
        reflectance: random if not given.
        exponent_bias: of BAFE-Net's last layer, if it is to start with certain exponents.
        exposures: logarithms of the gains of F frames.
        curve: tone curve of all frames.
        paths: T of them, of which those of finite lifetime, which come last, follow the first ones one by one.
        lifetimes: see `Gaussians`.
    """

    points: Float[Array, "P 3"]
    bounds: Float[Array, "2 3"]
    log_scales: Float[Array, " P"]
    illumination: Float[Array, " P"]
    logit_opacities: Float[Array, " P"]
    extent: Float[Array, ""]
    reflectance: Float[Array, "P 3"] | None
    exponent_bias: Float[Array, "2"] | None
    exposures: Float[Array, "F 3"] | None
    curve: Float[Array, " R"] | None
    paths: Float[Array, "T K 3"] | None
    lifetimes: Float[Array, "P 2"] | None


@partial(jax.jit, static_argnames=("cfg", "num_frames", "capacity"))
def _initialise(key: PRNGKeyArray, start: _Start, *, cfg: ModelConfig, num_frames: int, capacity: int) -> Scene:
    """See `initialise`."""
    count, num_rest = len(start.points), (cfg.sh_degree + 1) ** 2 - 1
    keys = jax.random.split(key, 6)
    random = {"normal": jax.random.normal, "uniform": jax.random.uniform}
    gaussians = Gaussians(
        means=start.points,
        quats=jnp.tile(jnp.array([[1.0, 0.0, 0.0, 0.0]]), (count, 1)),
        log_scales=jnp.tile(start.log_scales[:, None], (1, 3)),
        logit_opacities=start.logit_opacities,
        illumination_dc=start.illumination[:, None] / SH_DC,
        illumination_rest=jnp.zeros((count, num_rest)),
        reflectance=random[cfg.reflectance_init](keys[0], (count, 3))
        if start.reflectance is None
        else start.reflectance,
        attenuation=random[cfg.attenuation_init](keys[1], (count, 2)),
        gate=jnp.full(count, INITIAL_GATE, float) if cfg.motion_gate else None,
        lifetimes=start.lifetimes,
        color_rest=jnp.zeros((count, 3, num_rest)) if cfg.decomposition != "retinex" else None,
    )
    path_of = None
    if start.lifetimes is not None:
        path_of = jnp.maximum(jnp.cumsum(has_path(start.lifetimes)) - 1, 0).astype(jnp.int32)
    curves = None
    if cfg.decomposition == "curve" and start.curve is not None:
        curves = ToneCurves(start.curve, jnp.zeros((num_frames, RAMPS)))
    params = SceneParams(
        gaussians=jax.tree.map(lambda rows: pad_rows(rows, capacity), gaussians),
        hexplane=hexplane.init(keys[2], cfg, num_frames),
        heads=networks.init_heads(keys[3], cfg.plane_channels * len(cfg.plane_scales), cfg),
        ocd=networks.init_ocd(keys[4], cfg),
        bafe=networks.init_bafe(keys[5], start.exponent_bias),
        paths=start.paths,
        exposures=start.exposures if cfg.exposure == "drifting" else None,
        curves=curves,
    )
    return Scene(
        params=params,
        alive=jnp.arange(capacity) < count,
        bounds=start.bounds,
        extent=start.extent,
        path_of=None if path_of is None else pad_rows(path_of, capacity),
    )


def pad_rows(rows: Shaped[Array, "N ..."], capacity: int) -> Shaped[Array, "M ..."]:
    """Append zero rows up to `capacity`."""
    return jnp.pad(rows, [(0, capacity - rows.shape[0])] + [(0, 0)] * (rows.ndim - 1))
