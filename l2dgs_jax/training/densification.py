"""Clone, split and prune Gaussians inside a fixed capacity (adaptive density control, arXiv 2308.04079 section 5.2)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from l2dgs_jax.config import DensityConfig
from l2dgs_jax.types import Gaussians

SPLIT_SHRINK = 1.6  # factor between a split Gaussian's scales and its children's


class GrowthStats(NamedTuple):
    """Sums since the last densification.

    Attributes:
        gradient: norm of dL/d(mean2d) in normalised device coordinates.
        seen: number of steps in which the Gaussian was drawn.
    """

    gradient: Float[Array, "*S N"]
    seen: Float[Array, "*S N"]


class Densified(NamedTuple):
    """What `densify`, and `relocate` in relocation.py, return.

    Attributes:
        gaussians: rows after cloning and splitting.
        alive: which rows exist.
        changed: rows that were written or died: their optimizer state and statistics start anew.
        source: the row that each row is a copy of; its own if it is none.
        wanted: free rows that were needed.
        missing: how many of these were lacking; if any, the caller grows the capacity and calls again.
    """

    gaussians: Gaussians
    alive: Bool[Array, " N"]
    changed: Bool[Array, " N"]
    source: Int[Array, " N"]
    wanted: Int[Array, ""]
    missing: Int[Array, ""]


def empty_stats(capacity: int) -> GrowthStats:
    """Statistics of no step at all."""
    return GrowthStats(jnp.zeros(capacity), jnp.zeros(capacity))


def accumulate(
    stats: GrowthStats, probe_gradient: Float[Array, "N 2"], radii: Float[Array, " N"], width: int, height: int
) -> GrowthStats:
    """Add one step: the norm of the views' summed gradients, and one sighting for a Gaussian drawn in any view.

    Args:
        stats: so far.
        probe_gradient: dL/d(mean2d) in pixels, summed over the views.
        radii: of each Gaussian, the largest in any view, pixels; 0 if it was not drawn.
        width: pixels.
        height: pixels.
    """
    to_ndc = 0.5 * jnp.array([width, height], probe_gradient.dtype)
    norm = jnp.linalg.norm(probe_gradient * to_ndc[None], axis=-1)
    return GrowthStats(stats.gradient + norm, stats.seen + (radii > 0).astype(stats.seen.dtype))


def most_gaussians(cfg: DensityConfig) -> Int[Array, ""] | int:
    """The largest number of Gaussians that may exist; "auto" is resolved by then."""
    return cfg.max_gaussians  # type: ignore[return-value]


def densify(
    gaussians: Gaussians,
    alive: Bool[Array, " N"],
    stats: GrowthStats,
    extent: Float[Array, ""],
    key: PRNGKeyArray,
    cfg: DensityConfig,
) -> Densified:
    """Prune transparent Gaussians, then clone small and split large ones among those of large screen-space gradients.

    A clone leaves its source alone, except for its opacity with `cfg.conserve_opacity`; a split moves the source to one
    sample of itself and a new row to another, both smaller. If `cfg.max_gaussians` leaves too few rows, those with the
    largest gradients win. Nothing here is differentiable.
    """
    capacity = alive.shape[0]
    transparent = jax.nn.sigmoid(gaussians.logit_opacities) < cfg.prune_opacity
    pruned = alive & transparent & (alive.sum() > cfg.prune_above)
    alive_kept = alive & ~pruned

    mean_gradient = stats.gradient / jnp.maximum(stats.seen, 1)
    underfitting = alive_kept & (mean_gradient >= cfg.grad_threshold)
    free = (~alive_kept).sum()
    budget = jnp.maximum(most_gaussians(cfg) - alive_kept.sum(), 0)
    wanted = jnp.minimum(underfitting.sum(), budget)

    by_gradient = jnp.argsort(jnp.where(underfitting, -mean_gradient, jnp.inf))
    rank = jnp.argsort(by_gradient)
    chosen = underfitting & (rank < jnp.minimum(wanted, free))
    free_rows = jnp.nonzero(~alive_kept, size=capacity, fill_value=capacity)[0]
    target = jnp.where(chosen, free_rows[rank], capacity)  # row `capacity` does not exist: the write is dropped

    split = chosen & (jnp.exp(gaussians.log_scales).max(-1) > cfg.clone_below * extent)
    if cfg.conserve_opacity:
        # Two Gaussians of opacity 1 - sqrt(1 - o), one behind the other, cover what one of opacity o did.
        transmittance = jnp.sqrt(jax.nn.sigmoid(-gaussians.logit_opacities))
        shared = jnp.log1p(-transmittance) - jnp.log(transmittance)
        gaussians = gaussians._replace(logit_opacities=jnp.where(chosen, shared, gaussians.logit_opacities))
    first, second = (_sample(gaussians, split, k) for k in jax.random.split(key))
    written = jax.tree.map(lambda old, new: old.at[target].set(new, mode="drop"), first, second)
    born = jnp.zeros(capacity, bool).at[target].set(True, mode="drop")
    rows = jnp.arange(capacity, dtype=jnp.int32)
    return Densified(
        gaussians=written,
        alive=alive_kept | born,
        changed=pruned | born | (chosen if cfg.conserve_opacity else split),
        source=rows.at[target].set(rows, mode="drop"),
        wanted=wanted,
        missing=jnp.maximum(wanted - free, 0),
    )


def _sample(gaussians: Gaussians, split: Bool[Array, " N"], key: PRNGKeyArray) -> Gaussians:
    """Rows of `split` replaced by a smaller Gaussian centred at a sample of themselves; the others unchanged."""
    scales = jnp.exp(gaussians.log_scales)
    local = scales * jax.random.normal(key, scales.shape, scales.dtype)
    offset = rotate(gaussians.quats, local)
    pick = split[:, None]
    return gaussians._replace(
        means=jnp.where(pick, gaussians.means + offset, gaussians.means),
        log_scales=jnp.where(pick, gaussians.log_scales - jnp.log(SPLIT_SHRINK), gaussians.log_scales),
    )


def rotate(quats: Float[Array, "N 4"], vectors: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    """Vectors rotated by quaternions (wxyz) of any norm."""
    unit = quats / jnp.maximum(jnp.linalg.norm(quats, axis=-1, keepdims=True), 1e-12)
    w, axis = unit[:, :1], unit[:, 1:]
    # v + 2 q_v x (q_v x v + w v) rotates v by a unit quaternion (w, q_v).
    return vectors + 2 * jnp.cross(axis, jnp.cross(axis, vectors) + w * vectors)
