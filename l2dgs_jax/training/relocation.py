"""Growth inside a fixed capacity, as Markov chain Monte Carlo: relocation, births and noise (arXiv 2404.09591).

There copies of a Gaussian are left where it is, for the noise to part them in the course of tens of thousands of steps.
In a short training they would stay in one place, as good as one: their gradients have one direction, and Adam takes
steps of one length. So they are parted at birth (`spread`).
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from l2dgs_jax.training.densification import Densified, rotate
from l2dgs_jax.types import Gaussians

MOST = 51  # Gaussians that one may become at once; those beyond are as opaque as they
MOST_OPAQUE = 12.0  # logit of the opacity that is shared: beyond it Eq. 9 is lost in rounding
LEAST_NEED = 1e-12  # of any Gaussian: where none needs copies, opacity decides
STEEPNESS = 100.0  # of the noise's end as a Gaussian's opacity exceeds what counts as dead
# Row n - 1 holds the signed binomials (-1)^(k - 1) C(n, k) / sqrt(k) for k = 1 ... MOST.
_WEIGHTS = np.array(
    [[(-1) ** (k - 1) * math.comb(n, k) / math.sqrt(k) for k in range(1, MOST + 1)] for n in range(1, MOST + 1)]
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
    """Move dead Gaussians onto live ones and let others be born there, so that the image stays nearly what it was.

    Sources are drawn in proportion to their opacity, and to `need` if that is given. A Gaussian that becomes n of them
    shares its opacity among them, and they shrink so that together they cover what it did (Eq. 9 there). Nothing here
    is differentiable.

    Args:
        gaussians: rows, N of them.
        alive: which rows exist.
        count: how many are to exist, at most N.
        key: randomness.
        dead_below: opacity at which a Gaussian is dead.
        spread: standard deviation of the copies' centres, in the scales that Eq. 9 leaves them, below 1. They shrink
            so that on average they keep that covariance together. With 0 all stay where their source is.
        need: of each Gaussian for copies, 0 or more; None for the same.
    """
    capacity = alive.shape[0]
    opacities = jnp.where(alive, jax.nn.sigmoid(gaussians.logit_opacities), 0)
    live = opacities > dead_below
    born = ~alive & (jnp.cumsum(~alive) <= count - alive.sum())
    filled = (born | (alive & ~live)) & live.any()

    weights = opacities if need is None else opacities * (need + LEAST_NEED)
    chances = jnp.cumsum(jnp.where(live, weights, 0))
    drawn = jax.random.uniform(key, (capacity,), chances.dtype) * chances[-1]
    source = jnp.minimum(jnp.searchsorted(chances, drawn, side="right"), capacity - 1)
    likeliest = jnp.argmax(jnp.where(live, weights, 0)).astype(source.dtype)
    source = jnp.where(live[source], source, likeliest)  # rounding may lead beyond those that live
    copies = jnp.zeros(capacity, jnp.int32).at[jnp.where(filled, source, capacity)].add(1, mode="drop")

    # (1 - new)^n = 1 - old, through logarithms.
    number = jnp.minimum(copies + 1, MOST)
    passed = jax.nn.log_sigmoid(-jnp.minimum(gaussians.logit_opacities, MOST_OPAQUE)) / number.astype(opacities.dtype)
    shared = -jnp.expm1(passed)
    powers = shared[:, None] ** jnp.arange(1, MOST + 1, dtype=shared.dtype)[None]
    cover = (jnp.asarray(_WEIGHTS, shared.dtype)[number - 1] * powers).sum(-1)
    split = copies > 0
    sources = gaussians._replace(
        logit_opacities=jnp.where(split, jnp.log(shared) - passed, gaussians.logit_opacities),
        log_scales=jnp.where(split, jnp.log(opacities / cover), 0)[:, None] + gaussians.log_scales,
    )
    take = jnp.where(filled, source, jnp.arange(capacity, dtype=source.dtype))
    copied = jax.tree.map(lambda rows: rows[take], sources)
    return Densified(
        gaussians=_parted(copied, take, filled | split, jax.random.fold_in(key, 1), spread),
        alive=alive | (born & filled),
        changed=filled | split,
        wanted=jnp.zeros_like(count),
        missing=jnp.zeros_like(count),
    )


def _parted(
    gaussians: Gaussians, source: Int[Array, " N"], copied: Bool[Array, " N"], key: PRNGKeyArray, spread: float
) -> Gaussians:
    """Copies moved apart at random, those of one source by 0 on average; what is not `copied` stays as it is."""
    dtype = gaussians.means.dtype
    together = lambda rows: jnp.zeros_like(rows).at[source].add(jnp.where(copied[:, None], rows, 0))[source]
    number = jnp.maximum(together(jnp.ones((len(source), 1), dtype)), 2)
    drawn = jax.random.normal(key, gaussians.means.shape, dtype)
    apart = (drawn - together(drawn) / number) * jnp.sqrt(number / (number - 1))
    offsets = rotate(gaussians.quats, spread * jnp.exp(gaussians.log_scales) * apart)
    shrinking = math.log1p(-(spread**2)) / 2
    return gaussians._replace(
        means=gaussians.means + jnp.where(copied[:, None], offsets, 0),
        log_scales=gaussians.log_scales + jnp.where(copied[:, None], shrinking, 0),
    )


def population(alive: Int[Array, ""], most: Int[Array, ""] | int, growths: Int[Array, ""] | int) -> Int[Array, ""]:
    """How many Gaussians are to exist now, if in so many growths of equal factors there are to be `most`."""
    now, end, parts = (jnp.asarray(x, float) for x in (alive, jnp.maximum(most, alive), jnp.maximum(growths, 1)))
    return jnp.round(now * (end / now) ** (1 / parts)).astype(alive.dtype)


def disturb(
    gaussians: Gaussians,
    alive: Bool[Array, " N"],
    size: Float[Array, ""],
    key: PRNGKeyArray,
    dead_below: Float[Array, ""] | float,
) -> Gaussians:
    """Noise on the centres of faint Gaussians, which explore before they settle (Eq. 8 there).

    Args:
        gaussians: rows.
        alive: which of them exist; the others are left alone.
        size: of the noise, in covariances of a Gaussian, world units^-1.
        key: randomness.
        dead_below: opacity at which a Gaussian is dead: noise fades above it.
    """
    opacities = jax.nn.sigmoid(gaussians.logit_opacities)
    faint = jax.nn.sigmoid(STEEPNESS * (dead_below - opacities))
    local = jnp.exp(2 * gaussians.log_scales) * jax.random.normal(key, gaussians.means.shape, gaussians.means.dtype)
    # Isotropic noise need not be turned into the axes of the Gaussian, only out of them.
    noise = size * faint[:, None] * rotate(gaussians.quats, local)
    return gaussians._replace(means=jnp.where(alive[:, None], gaussians.means + noise, gaussians.means))
