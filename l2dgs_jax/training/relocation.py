"""Growth inside a fixed capacity, as Markov chain Monte Carlo: relocation, births and noise (3DGS-MCMC).

In that paper (arXiv 2404.09591) copies of a Gaussian start where it is, and noise separates them in the course of tens
of thousands of steps. In a short training they would stay together and act as one: their gradients have the same
direction, and Adam's steps the same length. So copies can be spread out at birth (`spread`).
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from l2dgs_jax.training.densification import Densified, rotate
from l2dgs_jax.types import Gaussians

MAX_COPIES = 51  # Gaussians among which one shares its opacity at once; further ones get the same opacity and scale
MAX_LOGIT = 12.0  # of an opacity that is shared: above it Eq. 9 is dominated by rounding errors
MIN_NEED = 1e-12  # added to every Gaussian's need: if none needs copies, opacity alone decides
NOISE_STEEPNESS = 100.0  # of the sigmoid by which noise fades as a Gaussian's opacity rises above the dead threshold
# Row n - 1 holds the signed binomials (-1)^(k - 1) C(n, k) / sqrt(k) for k = 1 ... MAX_COPIES.
_SIGNED_BINOMIALS = np.array(
    [
        [(-1) ** (k - 1) * math.comb(n, k) / math.sqrt(k) for k in range(1, MAX_COPIES + 1)]
        for n in range(1, MAX_COPIES + 1)
    ]
)


def relocate(
    gaussians: Gaussians,
    alive: Bool[Array, " N"],
    count: Int[Array, ""],
    key: PRNGKeyArray,
    dead_below: Float[Array, ""] | float,
    spread: float = 0.0,
    need: Float[Array, " N"] | None = None,
) -> Densified:
    """Move dead Gaussians onto live ones, and add new ones there, so that the image stays nearly the same.

    Live Gaussians are drawn as sources in proportion to their opacity, and to `need` if that is given. One that becomes
    n Gaussians shares its opacity among them, and they shrink so that together they cover what it did (Eq. 9 of the
    paper). Nothing here is differentiable.

    Args:
        gaussians: rows, N of them.
        alive: which rows exist.
        count: how many are to exist, at most N.
        key: randomness.
        dead_below: opacity at which a Gaussian is dead.
        spread: standard deviation of the copies' centres, below 1, in units of the scales by Eq. 9. Copies shrink
            further, so that together they keep on average the covariance by Eq. 9. With 0 all stay at their source.
        need: of each Gaussian for copies, 0 or more; None if all have the same.
    """
    capacity = alive.shape[0]
    opacities = jnp.where(alive, jax.nn.sigmoid(gaussians.logit_opacities), 0)
    live = opacities > dead_below
    born = ~alive & (jnp.cumsum(~alive) <= count - alive.sum())
    filled = (born | (alive & ~live)) & live.any()

    weights = opacities if need is None else opacities * (need + MIN_NEED)
    cumulative = jnp.cumsum(jnp.where(live, weights, 0))
    drawn = jax.random.uniform(key, (capacity,), cumulative.dtype) * cumulative[-1]
    source = jnp.minimum(jnp.searchsorted(cumulative, drawn, side="right"), capacity - 1)
    likeliest = jnp.argmax(jnp.where(live, weights, 0)).astype(source.dtype)
    source = jnp.where(live[source], source, likeliest)  # rounding may pick a row that is not live
    copies = jnp.zeros(capacity, jnp.int32).at[jnp.where(filled, source, capacity)].add(1, mode="drop")

    # (1 - new)^n = 1 - old, through logarithms.
    number = jnp.minimum(copies + 1, MAX_COPIES)
    log_transmittance = jax.nn.log_sigmoid(-jnp.minimum(gaussians.logit_opacities, MAX_LOGIT))
    log_share = log_transmittance / number.astype(opacities.dtype)
    shared = -jnp.expm1(log_share)
    powers = shared[:, None] ** jnp.arange(1, MAX_COPIES + 1, dtype=shared.dtype)[None]
    cover = (jnp.asarray(_SIGNED_BINOMIALS, shared.dtype)[number - 1] * powers).sum(-1)
    split = copies > 0
    sources = gaussians._replace(
        logit_opacities=jnp.where(split, jnp.log(shared) - log_share, gaussians.logit_opacities),
        log_scales=jnp.where(split, jnp.log(opacities / cover), 0)[:, None] + gaussians.log_scales,
    )
    take = jnp.where(filled, source, jnp.arange(capacity, dtype=source.dtype))
    copied = jax.tree.map(lambda rows: rows[take], sources)
    return Densified(
        gaussians=_spread_copies(copied, take, filled | split, jax.random.fold_in(key, 1), spread),
        alive=alive | (born & filled),
        changed=filled | split,
        source=take,
        wanted=jnp.zeros_like(count),
        missing=jnp.zeros_like(count),
    )


def _spread_copies(
    gaussians: Gaussians, source: Int[Array, " N"], copied: Bool[Array, " N"], key: PRNGKeyArray, spread: float
) -> Gaussians:
    """Copies moved apart at random, those of one source by 0 on average; rows that are not `copied` stay in place."""
    dtype = gaussians.means.dtype
    sum_of_copies = lambda rows: jnp.zeros_like(rows).at[source].add(jnp.where(copied[:, None], rows, 0))[source]
    number = jnp.maximum(sum_of_copies(jnp.ones((len(source), 1), dtype)), 2)
    drawn = jax.random.normal(key, gaussians.means.shape, dtype)
    centred = (drawn - sum_of_copies(drawn) / number) * jnp.sqrt(number / (number - 1))
    offsets = rotate(gaussians.quats, spread * jnp.exp(gaussians.log_scales) * centred)
    shrinkage = math.log1p(-(spread**2)) / 2
    return gaussians._replace(
        means=gaussians.means + jnp.where(copied[:, None], offsets, 0),
        log_scales=gaussians.log_scales + jnp.where(copied[:, None], shrinkage, 0),
    )


def population(alive: Int[Array, ""], most: Int[Array, ""] | int, growths: Int[Array, ""] | int) -> Int[Array, ""]:
    """How many Gaussians are to exist after this growth, if `growths` by equal factors are to lead to `most`."""
    now, end, parts = (jnp.asarray(x, float) for x in (alive, jnp.maximum(most, alive), jnp.maximum(growths, 1)))
    return jnp.round(now * (end / now) ** (1 / parts)).astype(alive.dtype)


def disturb(
    gaussians: Gaussians,
    alive: Bool[Array, " N"],
    size: Float[Array, ""],
    key: PRNGKeyArray,
    dead_below: Float[Array, ""] | float,
) -> Gaussians:
    """Noise on the centres of faint Gaussians, by which they explore before they settle (Eq. 8 of the paper).

    Args:
        gaussians: rows.
        alive: which of them exist; the others are left alone.
        size: of the noise: a factor on the Gaussian's covariance, world units^-1.
        key: randomness.
        dead_below: opacity at which a Gaussian is dead: noise fades above it.
    """
    opacities = jax.nn.sigmoid(gaussians.logit_opacities)
    faint = jax.nn.sigmoid(NOISE_STEEPNESS * (dead_below - opacities))
    local = jnp.exp(2 * gaussians.log_scales) * jax.random.normal(key, gaussians.means.shape, gaussians.means.dtype)
    # Isotropic noise need not be rotated into the axes of the Gaussian before its covariance scales it, only back.
    noise = size * faint[:, None] * rotate(gaussians.quats, local)
    return gaussians._replace(means=jnp.where(alive[:, None], gaussians.means + noise, gaussians.means))
