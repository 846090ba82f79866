"""Distance by parallax: while the camera shakes, what moves smoothly seems to shake, the more the nearer it is."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

SPACINGS = 2, 3  # observations from one to the next of the four that a window consists of
WEIGHT = 0.2  # of a window's absolute error in standard deviations; below 1, as the errors of neighbours are correlated
MIN_SIGMA = 0.4  # standard deviation of a track from a smooth path: at least this, pixels
SIGMA = 0.0015  # and this, focal lengths
MAX_STEP = 1.0  # of a log-distance at a time
MAX_WEIGHT = 10.0  # of an estimate; one that counts more would outweigh the smoothness of the distances


class Windows(NamedTuple):
    """Four observations of a track each, W in all.

    Attributes:
        places: of the observations among those of all tracks.
        factors: weights of values at their times in the third divided difference, scaled to unit norm.
    """

    places: Int[np.ndarray, "W 4"]
    factors: Float[np.ndarray, "W 4"]


def find_windows(numbers: Int[np.ndarray, " O"], times: Float[np.ndarray, " O"]) -> Windows:
    """All windows of observations that are grouped by track and in order of time.

    Args:
        numbers: of the tracks that they belong to.
        times: at which they are made, different within a track.
    """
    starts = np.arange(len(numbers))[:, None]
    places = np.concatenate([starts[: -3 * spacing] + spacing * np.arange(4) for spacing in SPACINGS])
    places = places[numbers[places[:, 0]] == numbers[places[:, -1]]]
    apart = times[places][:, :, None] - times[places][:, None]
    factors = 1 / np.prod(apart + np.eye(4), axis=-1)
    return Windows(places, factors / np.linalg.norm(factors, axis=-1, keepdims=True))


def estimates(
    windows: Windows,
    distances: Float[np.ndarray, " O"],
    centres: Float[np.ndarray, "O 3"],
    rays: Float[np.ndarray, "O 3"],
    focal_length: float,
) -> tuple[Float[np.ndarray, " W"], Float[np.ndarray, " W"]]:
    """The mean log-distance in each window that explains best how it seems to shake, and its weight in least squares.

    The third divided differences of a smooth path are almost 0; those of a shaking camera are not. So the path, seen
    from the camera, has third differences that are the camera's, negated, and their part across the line of sight,
    divided by the distance, is visible. What else there is in the path does not matter on average, as long as it does
    not depend on the camera. Errors beyond one standard deviation count by their absolute value, which takes several
    rounds of estimation (iteratively reweighted least squares).

    Args:
        windows: of the observations.
        distances: present estimates, logarithms of world units: a point is at `centre + exp(distance) * ray`.
        centres: of the cameras, world units.
        rays: from there to the observed points, per unit of distance.
        focal_length: of the cameras, pixels.
    """
    places, factors = windows
    common = distances[places].mean(-1)
    relative = np.exp(distances[places] - common[:, None])
    camera = np.exp(-common)[:, None] * np.einsum("wk,wkc->wc", factors, centres[places])
    path = camera + np.einsum("wk,wkc->wc", factors * relative, rays[places])
    lengths = np.linalg.norm(rays[places[:, 1]], axis=-1)
    sight = rays[places[:, 1]] / lengths[:, None]
    camera, path = (x - (x * sight).sum(-1, keepdims=True) * sight for x in (camera, path))
    per_sigma = 1 / (max(SIGMA, MIN_SIGMA / focal_length) * lengths)
    deviations = per_sigma * np.linalg.norm(path, axis=-1)
    visible = np.square(camera).sum(-1)
    step = (camera * path).sum(-1) / np.maximum(visible, np.finfo(float).tiny)
    weights = WEIGHT * np.square(per_sigma) * visible / np.maximum(deviations, 1)
    return common + np.clip(step, -MAX_STEP, MAX_STEP), np.minimum(weights, MAX_WEIGHT)
