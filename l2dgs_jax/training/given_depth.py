"""How far rendered depth is from depth that came with the scene, of which scale and shift are not known."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

OPAQUE = 0.5  # alpha from which a pixel has a depth
TOLERANCE = 0.02  # of the mean inverse depth, up to which differences count as squares
FLAT = 1e-4  # of the mean: depth that varies no more than that says nothing
ROUNDS = 20  # of the search for scale and shift


def depth_disagreement(
    depth: Float[Array, "V H W"], alpha: Float[Array, "V H W"], given: Float[Array, "V H W"]
) -> Float[Array, ""]:
    """Mean robust difference of inverse depths, each view's given ones at their best scale and shift.

    Inverse depth is what networks guess (MiDaS, arXiv 1907.01341), and far things differ little in it, as they should.
    Differences are parts of the view's mean inverse depth and count by their size (pseudo-Huber), so that edges in the
    wrong place do not decide. Pixels without depth add nothing to the mean over all.

    Gradients flow to `depth` and `alpha`, whose quotient is a ray's depth however opaque it is. Scale and shift are
    held constant: where they are best the loss does not change with them.

    Args:
        depth: accumulated along rays, sum of alpha T z, in any unit.
        alpha: accumulated opacity.
        given: depth in any unit, 0 where unknown.
    """
    known = (given > 0) & (jax.lax.stop_gradient(alpha) > OPAQUE)
    rendered = _over_mean(jnp.where(known, alpha / jnp.where(known, depth, 1), 0), known)
    told = _over_mean(jnp.where(known, 1 / jnp.where(known, given, 1), 0), known)
    aim = jax.lax.stop_gradient(rendered)

    def fitted(weights: Float[Array, "V H W"]) -> Float[Array, "V H W"]:
        """What is told, brought as near to the rendered by weighted least squares as a scale >= 0 and a shift can."""

        def mean(values: Float[Array, "V H W"]) -> Float[Array, "V 1 1"]:
            return (weights * values).sum((1, 2), keepdims=True) / jnp.maximum(weights.sum((1, 2), keepdims=True), 1e-6)

        offset = told - mean(told)
        scale = mean(offset * (aim - mean(aim))) / jnp.maximum(mean(offset**2), FLAT**2)
        return mean(aim) + jnp.maximum(scale, 0) * offset

    def reweighted(_: int | Int[Array, ""], weights: Float[Array, "V H W"]) -> Float[Array, "V H W"]:
        return jnp.where(known, 1 / jnp.sqrt(1 + ((aim - fitted(weights)) / TOLERANCE) ** 2), 0)

    weights = jax.lax.fori_loop(0, ROUNDS, reweighted, known.astype(depth.dtype))
    difference = (rendered - fitted(weights)) / TOLERANCE
    return TOLERANCE * jnp.where(known, jnp.sqrt(1 + difference**2) - 1, 0).mean()


def _over_mean(values: Float[Array, "V H W"], counted: Bool[Array, "V H W"]) -> Float[Array, "V H W"]:
    """Values, 0 where they do not count, as parts of the view's mean of those that do."""
    count = jnp.maximum(counted.sum((1, 2), keepdims=True), 1).astype(values.dtype)
    mean = values.sum((1, 2), keepdims=True) / count
    return values / jnp.where(mean > 0, mean, 1)
