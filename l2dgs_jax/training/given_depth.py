"""Depth that came with the scene, at an unknown scale and shift: its distance from rendered depth, and its unit."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int

from l2dgs_jax.data.depth_maps import at_points

MIN_ALPHA = 0.5  # accumulated opacity above which a pixel has a depth
HUBER_DELTA = 0.02  # of the mean inverse depth: differences below it count quadratically, above it linearly
MIN_DEVIATION = 1e-4  # standard deviation, over the mean, below which given inverse depth counts as constant
FIT_ITERATIONS = 20  # of reweighted least squares for scale and shift
MIN_POINTS = 10  # in a frame, to find its scale and shift by
POINT_TOLERANCE = 0.1  # of the median inverse depth of points: one that is farther off counts little


def depth_disagreement(
    depth: Float[Array, "V H W"], alpha: Float[Array, "V H W"], given: Float[Array, "V H W"]
) -> Float[Array, ""]:
    """Mean robust difference of inverse depths, each view's given ones at their best scale and shift.

    Inverse depth is what networks predict (MiDaS, arXiv 1907.01341), and errors of far things count little in it, as
    they should. Differences are relative to the view's mean inverse depth and robust (pseudo-Huber), so that misplaced
    edges do not dominate. Pixels without depth add 0 to the mean over all pixels.

    Gradients flow to `depth` and `alpha`, whose quotient is a ray's depth however opaque it is. Scale and shift are
    held constant: where they are best the loss does not change with them.

    Args:
        depth: accumulated along rays, sum of alpha T z, in any unit.
        alpha: accumulated opacity.
        given: depth in any unit, 0 where unknown.
    """
    known = (given > 0) & (jax.lax.stop_gradient(alpha) > MIN_ALPHA)
    rendered = _over_mean(jnp.where(known, alpha / jnp.where(known, depth, 1), 0), known)
    given_inverse = _over_mean(jnp.where(known, 1 / jnp.where(known, given, 1), 0), known)
    target = jax.lax.stop_gradient(rendered)

    def fitted(weights: Float[Array, "V H W"]) -> Float[Array, "V H W"]:
        """Given inverse depths at the scale >= 0 and shift that fit the rendered ones best (weighted least squares)."""

        def mean(values: Float[Array, "V H W"]) -> Float[Array, "V 1 1"]:
            return (weights * values).sum((1, 2), keepdims=True) / jnp.maximum(weights.sum((1, 2), keepdims=True), 1e-6)

        offset = given_inverse - mean(given_inverse)
        scale = mean(offset * (target - mean(target))) / jnp.maximum(mean(offset**2), MIN_DEVIATION**2)
        return mean(target) + jnp.maximum(scale, 0) * offset

    def reweighted(_: int | Int[Array, ""], weights: Float[Array, "V H W"]) -> Float[Array, "V H W"]:
        return jnp.where(known, 1 / jnp.sqrt(1 + ((target - fitted(weights)) / HUBER_DELTA) ** 2), 0)

    weights = jax.lax.fori_loop(0, FIT_ITERATIONS, reweighted, known.astype(depth.dtype))
    difference = (rendered - fitted(weights)) / HUBER_DELTA
    return HUBER_DELTA * jnp.where(known, jnp.sqrt(1 + difference**2) - 1, 0).mean()


def _over_mean(values: Float[Array, "V H W"], counted: Bool[Array, "V H W"]) -> Float[Array, "V H W"]:
    """Values, which are 0 where they do not count, over the view's mean of those that do."""
    count = jnp.maximum(counted.sum((1, 2), keepdims=True), 1).astype(values.dtype)
    mean = values.sum((1, 2), keepdims=True) / count
    return values / jnp.where(mean > 0, mean, 1)


def in_world_units(
    given: Float32[np.ndarray, "H W"],
    points: Float[np.ndarray, "P 3"],
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, "H W"]:
    """Depth given for one frame at the scale and shift of its inverse that suit the scene's points best.

    Points that other things hide in this frame are outliers. Least squares are therefore reweighted in the manner of
    Geman and McClure, whose weights fall fast enough for those not to matter.

    Args:
        given: depth in any unit, 0 where unknown.
        points: world units.
        viewmat: of the frame's camera.
        K: likewise.

    Returns:
        Depth in world units, NaN where unknown, and everywhere if too few points are in view or agree with it.
    """
    told, target = 1 / at_points(given, points, viewmat, K).astype(np.float64)
    if len(told) < MIN_POINTS:
        return np.full(given.shape, np.nan)
    terms = np.stack([told, np.ones(len(told))], axis=-1)
    weights = np.ones(len(target))
    for _ in range(FIT_ITERATIONS):
        (scale, shift), *_ = np.linalg.lstsq(weights[:, None] * terms, weights * target)
        errors = (terms @ (scale, shift) - target) / (POINT_TOLERANCE * np.median(target))
        weights = 1 / (1 + errors**2)  # roots of the weights of squares
    inverse = np.where(given > 0, scale / np.where(given > 0, given, 1) + shift, np.nan)
    agrees = scale > 0 and np.median(np.abs(errors)) < 1
    return np.where(agrees & (inverse > 0), 1 / np.where(inverse > 0, inverse, 1), np.nan)
