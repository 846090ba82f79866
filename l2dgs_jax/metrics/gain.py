"""The global gain that best matches predicted images to the ground truth."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

LEVELS = 2**14  # to which predictions are rounded to find where they saturate


def best_gain(frames: Iterable[tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]]) -> float:
    """The factor g >= 0 that minimises the mean of (min(g p, 1) - t)^2; 1 if all predictions are 0, NaN if one is NaN.

    A saturated value does not count against a larger factor, just as the eye does not notice it. Between the factors
    at which one more value saturates, the error is a parabola, so its minimum is found exactly, except that predictions
    are rounded to `LEVELS`.

    Args:
        frames: predictions p and ground truths t, in [0, 1].
    """
    square, product, beyond = np.zeros((3, LEVELS))  # sums of p^2, p t and 1 - 2 t, over the values of a level
    for prediction, truth in frames:
        p, t = (np.asarray(x, np.float64).ravel() for x in (prediction, truth))
        if not np.isfinite(p).all():
            return float("nan")
        level = np.minimum((p * LEVELS).astype(int), LEVELS - 1)
        square += np.bincount(level, p * p, LEVELS)
        product += np.bincount(level, p * t, LEVELS)
        beyond += np.bincount(level, 1 - 2 * t, LEVELS)
    if not square.any():
        return 1.0
    # If the levels up to the k-th do not saturate and the next one does, g lies between the inverses of the upper ends
    # of these two levels.
    below_square, below_product = np.cumsum(square), np.cumsum(product)
    saturated = beyond.sum() - np.cumsum(beyond)
    upper = LEVELS / np.arange(1, LEVELS + 1)
    lower = np.append(upper[1:], 0.0)
    free = np.divide(below_product, below_square, out=upper.copy(), where=below_square > 0)
    gains = np.clip(free, lower, upper)
    errors = gains**2 * below_square - 2 * gains * below_product + saturated
    return float(gains[np.argmin(errors)])
