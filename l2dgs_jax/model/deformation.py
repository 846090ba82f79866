"""Canonical Gaussians and instants -> Gaussians at those instants, lit as their cameras see them (Eqs. 1-4)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.cameras.geometry import camera_centres
from l2dgs_jax.config import ModelConfig
from l2dgs_jax.model import compaction, hexplane, networks, spherical_harmonics
from l2dgs_jax.types import Camera, Gaussians, MovedGaussians, Scene

MAX_GROWTH = 0.2  # bound of how much log-scales grow if their growth is bounded
FADE_DURATION = 0.25  # time in which a Gaussian on a path fades in or out, in spacings of the path's control points


def deform(
    scene: Scene,
    cameras: Camera,
    cfg: ModelConfig,
    *,
    moving: bool,
    sh_degree_active: Int[Array, ""] | int,
    presence: Float[Array, " N"] | None = None,
) -> MovedGaussians:
    """Move and light every Gaussian for V cameras, each at its own instant.

    Gradients flow to every leaf of `scene.params` that takes part and to `cameras`; rows that are not alive get none.

    Args:
        scene: the scene; rows that are not alive come out with opacity 0, whatever their parameters.
        cameras: V cameras.
        cfg: shape of the scene.
        moving: whether the motion field and OCD-Net act (fine stage); otherwise only paths do, with a_j = 1.
        sh_degree_active: bands of Eq. 2 above this one are left out; may be traced.
        presence: factor on the opacities, which stay at most 1; None for 1.

    Returns:
        Activated Gaussians; every field has a leading axis V.
    """
    params, alive = scene.params, scene.alive
    # Dead rows may hold any values: if exp overflowed on one, the gradient 0 * inf = NaN would reach shared networks.
    gaussians = jax.tree.map(
        lambda rows: jnp.where(alive.reshape(-1, *[1] * (rows.ndim - 1)), rows, 0), params.gaussians
    )
    per_view = lambda rows: jnp.broadcast_to(rows[None], (*cameras.time.shape, *rows.shape))
    raw = (gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities)
    means, quats, log_scales, logit_opacities = map(per_view, raw)
    dc_and_rest = jnp.concatenate([gaussians.illumination_dc, gaussians.illumination_rest], axis=-1)
    coefficients = per_view(_active(dc_and_rest, cfg.sh_degree, sh_degree_active))  # b_j of Eq. 2
    if moving:
        changes = _changes(scene, gaussians, cameras, cfg)
        means += length_unit(scene.extent, cfg) * changes.motion.means
        quats += changes.motion.quats
        log_scales += _growth(changes.motion.log_scales, cfg)
        if changes.motion.logit_opacities is not None:
            logit_opacities += changes.motion.logit_opacities
        if changes.light is not None:
            coefficients = (1 + changes.light) * coefficients
    opacities = jnp.where(alive[None], jax.nn.sigmoid(logit_opacities), 0)
    if params.paths is not None:
        assert scene.path_of is not None, "expected who follows the paths"
        assert gaussians.lifetimes is not None, "expected when they do"
        displacements, visibility = _on_paths(params.paths, scene.path_of, gaussians.lifetimes, cameras.time)
        means, opacities = means + displacements, visibility * opacities
    basis = _basis(gaussians.means, cameras.viewmat, cfg.sh_degree)
    reflectance = per_view(gaussians.reflectance)
    if gaussians.color_rest is not None:
        rest = _active(gaussians.color_rest, cfg.sh_degree, sh_degree_active)
        reflectance = jnp.maximum(reflectance + jnp.einsum("ncj,vnj->vnc", rest, basis[..., 1:]), 0)
    return MovedGaussians(
        means=means,
        quats=quats,
        scales=jnp.exp(log_scales),
        opacities=opacities if presence is None else jnp.minimum(presence[None] * opacities, 1),
        illumination=jnp.maximum(cfg.illumination_offset + jnp.einsum("...j,...j->...", coefficients, basis), 0),
        reflectance=reflectance,
        attenuation=per_view(gaussians.attenuation),
    )


class _Changes(NamedTuple):
    motion: networks.Motion
    light: Float[Array, "V N J"] | None  # a_j - 1


def _changes(scene: Scene, gaussians: Gaussians, cameras: Camera, cfg: ModelConfig) -> _Changes:
    """What the motion field changes in every Gaussian: nothing in those behind shut gates, which take no time."""
    params = scene.params

    def changes(shared: tuple, rows: tuple) -> _Changes:
        (planes, heads, ocd, bounds, times), (means, factor) = shared, rows
        # The same features feed the heads and OCD-Net: Eqs. 1 and 4 name them both f.
        hidden, motion = networks.apply_heads(heads, hexplane.features(planes, means, bounds, times, cfg))
        full = _Changes(motion, networks.apply_ocd(ocd, hidden) - 1 if cfg.ocd else None)
        if factor is None:
            return full
        return jax.tree.map(lambda change: factor.reshape(1, -1, *[1] * (change.ndim - 2)) * change, full)

    factor = None if gaussians.gate is None else openness(gaussians.gate, cfg)
    acts = scene.alive if factor is None else scene.alive & (factor > 0)
    shared = (params.hexplane, params.heads, params.ocd, scene.bounds, cameras.time)
    return compaction.map_chosen(changes, shared, (gaussians.means, factor), acts)


def openness(gate: Float[Array, " N"], cfg: ModelConfig) -> Float[Array, " N"]:
    """The factors in [0, 1] of motion gates; 0 below `cfg.shut_gates`, without gradient, so that they stay shut.

    Fading alone would not make a Gaussian static: where nothing moves, the field can grow as a gate closes.
    """
    factor = jax.nn.sigmoid(gate)
    return jnp.where(factor < cfg.shut_gates, 0, factor)


def _growth(log_scales: Float[Array, "V N 3"], cfg: ModelConfig) -> Float[Array, "V N 3"]:
    """What is added to the log-scales for their head's output x: x, or less if growth is bounded and x > 0."""
    if cfg.scale_growth == "exponential":
        return log_scales
    return MAX_GROWTH * jnp.tanh(jnp.maximum(log_scales, 0) / MAX_GROWTH) + jnp.minimum(log_scales, 0)


def _on_paths(
    paths: Float[Array, "P K 3"],
    path_of: Int[Array, " N"],
    lifetimes: Float[Array, "N 2"],
    times: Float[Array, " V"],
) -> tuple[Float[Array, "V N 3"], Float[Array, "V N"]]:
    """Displacements of Gaussians along their paths, and the factors by which lifetimes scale their opacities.

    Outside its lifetime a Gaussian fades within `FADE_DURATION`. Gaussians of infinite lifetime have no path: they stay
    in place, with a factor of 1. Gradients flow to paths, lifetimes and times.
    """
    knots = paths.shape[1]
    follows = has_path(lifetimes)
    first, last = jnp.where(follows[:, None], lifetimes, 0).T
    outside = jnp.maximum(first[None] - times[:, None], times[:, None] - last[None])
    visibility = jnp.clip(1 - (knots - 1) / FADE_DURATION * outside, 0, 1)
    near = min(4, knots)  # control points of non-zero weight at an instant: reading all takes many times as long
    start = jnp.clip(jnp.floor(_position(times, knots)).astype(jnp.int32) - 1, 0, knots - near)

    def displaced(weights: Float[Array, " K"], start: Int[Array, ""]) -> Float[Array, "P 3"]:
        points = jax.lax.dynamic_slice_in_dim(paths, start, near, 1)
        weights = jax.lax.dynamic_slice_in_dim(weights, start, near)
        # One by one: on a CPU, XLA's sums along short axes take far longer.
        return sum((weights[k] * points[:, k] for k in range(near)), jnp.zeros_like(points[:, 0]))

    own = jnp.where(follows, path_of, len(paths))
    displacements = jax.vmap(displaced)(path_weights(times, knots), start).at[:, own].get(mode="fill", fill_value=0)
    return displacements, jnp.where(follows[None], visibility, 1)


def has_path(lifetimes: Float[Array, "N 2"]) -> Bool[Array, " N"]:
    """Which Gaussians follow a path: those of finite lifetime."""
    return jnp.isfinite(lifetimes).all(-1)


def path_weights(times: Float[Array, " V"], knots: int) -> Float[Array, "V K"]:
    """Weights of a path's control points at instants in [0, 1]: a uniform cubic spline. Carries gradients."""
    position = _position(times, knots)
    distance = jnp.abs(position[:, None] - jnp.arange(knots, dtype=position.dtype)[None])
    near, far = jnp.minimum(distance, 1), jnp.clip(2 - distance, 0, 1)
    weights = jnp.where(distance < 1, 2 / 3 - near**2 + near**3 / 2, far**3 / 6)
    return weights / weights.sum(-1, keepdims=True)  # at both ends the spline reaches beyond the control points


def _position(times: Float[Array, " V"], knots: int) -> Float[Array, " V"]:
    """Instants in units of the spacing of control points."""
    return jnp.clip(times, 0, 1) * (knots - 1)


def length_unit(extent: Float[Array, ""] | float, cfg: ModelConfig) -> Float[Array, ""] | float:
    """The unit of length of motion, depths and scales in a scene of that extent, world units."""
    return extent if cfg.unit == "depth" else 1.0


def _basis(means: Float[Array, "N 3"], viewmat: Float[Array, "V 4 4"], degree: int) -> Float[Array, "V N J"]:
    """The spherical harmonics of Eqs. 2 and 3 towards each Gaussian.

    The view direction is taken from the canonical mean: the coefficients belong to the Gaussian, so its motion alone
    does not change how it is lit; that is left to OCD-Net.
    """
    everywhere = jnp.broadcast_to(means[None], (len(viewmat), *means.shape))
    return spherical_harmonics.basis(spherical_harmonics.directions(everywhere, camera_centres(viewmat)), degree)


def _active(coefficients: Float[Array, "*S J"], degree: int, active: Int[Array, ""] | int) -> Float[Array, "*S J"]:
    """Coefficients of spherical harmonics (all, or all but the first) with bands above `active` set to zero."""
    bands = np.repeat(np.arange(degree + 1, dtype=np.int32), 2 * np.arange(degree + 1) + 1)
    used = bands[len(bands) - coefficients.shape[-1] :] <= jnp.asarray(active, jnp.int32)
    return jnp.where(used.reshape(*[1] * (coefficients.ndim - 1), -1), coefficients, 0)
