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
    """Four observations of a track each, W in all, with what makes up their third differences across the line of sight.

    Attributes:
        places: of the observations among those of all tracks.
        rays: from the cameras per unit of distance, times their weights in the difference, across the line of sight.
        camera: the third difference of the cameras' centres across the line of sight, world units.
        lengths: of one of the rays per unit of distance.
    """

    places: Int[np.ndarray, "W 4"]
    rays: Float[np.ndarray, "W 4 3"]
    camera: Float[np.ndarray, "W 3"]
    lengths: Float[np.ndarray, " W"]


def find_windows(
    numbers: Int[np.ndarray, " O"],
    times: Float[np.ndarray, " O"],
    centres: Float[np.ndarray, "O 3"],
    rays: Float[np.ndarray, "O 3"],
) -> Windows:
    """All windows of observations that are grouped by track and in order of time.

    Args:
        numbers: of the tracks that they belong to.
        times: at which they are made, different within a track.
        centres: of the cameras, world units.
        rays: from there to the observed points, per unit of distance.
    """
    starts = np.arange(len(numbers))[:, None]
    places = np.concatenate([starts[: -3 * spacing] + spacing * np.arange(4) for spacing in SPACINGS])
    places = places[numbers[places[:, 0]] == numbers[places[:, -1]]]
    factors = third_difference(times[places])[..., None]
    lengths = np.linalg.norm(rays[places[:, 1]], axis=-1)
    sight = rays[places[:, 1]] / lengths[:, None]
    across = lambda x, sight: x - (x * sight).sum(-1, keepdims=True) * sight
    camera = across((factors * centres[places]).sum(1), sight)
    return Windows(places, across(factors * rays[places], sight[:, None]), camera, lengths)


def third_difference(times: Float[np.ndarray, "W 4"]) -> Float[np.ndarray, "W 4"]:
    """Weights of values at these times in their third divided difference, scaled to unit norm."""
    apart = times[:, :, None] - times[:, None]
    factors = 1 / np.prod(apart + np.eye(4), axis=-1)
    return factors / np.linalg.norm(factors, axis=-1, keepdims=True)


def estimates(
    windows: Windows, distances: Float[np.ndarray, " O"], focal_length: float
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
        focal_length: of the cameras, pixels.
    """
    common = distances[windows.places].mean(-1)
    relative = np.exp(distances[windows.places] - common[:, None])
    camera = np.exp(-common)[:, None] * windows.camera
    path = camera + np.einsum("wk,wkc->wc", relative, windows.rays)
    per_sigma = 1 / (max(SIGMA, MIN_SIGMA / focal_length) * windows.lengths)
    deviations = per_sigma * np.linalg.norm(path, axis=-1)
    visible = np.square(camera).sum(-1)
    step = (camera * path).sum(-1) / np.maximum(visible, np.finfo(float).tiny)
    weights = WEIGHT * np.square(per_sigma) * visible / np.maximum(deviations, 1)
    return common + np.clip(step, -MAX_STEP, MAX_STEP), np.minimum(weights, MAX_WEIGHT)
