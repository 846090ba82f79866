"""Distance by parallax: while the camera shakes, what moves smoothly seems to shake, the more the nearer it is."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse

SPACINGS = 2, 3  # observations from one to the next of the four that a window consists of
WEIGHT = 0.2  # of a window's absolute error, in standard deviations; less than 1, as neighbouring tracks err alike
PATH_SIGMA = 0.4  # standard deviation of a track from a smooth path, pixels


class Windows(NamedTuple):
    """Four observations of a track each, W in all.

    Attributes:
        places: of the observations among those of all tracks.
        factors: with which values at these times add up to their third difference in time; the squares sum to 1.
    """

    places: Int[np.ndarray, "W 4"]
    factors: Float[np.ndarray, "W 4"]


def windows(numbers: Int[np.ndarray, " O"], times: Float[np.ndarray, " O"]) -> Windows:
    """All windows of observations that are grouped by track and in order of time.

    Args:
        numbers: of the tracks that they belong to.
        times: at which they are made, different within a track.
    """
    starts = np.arange(len(numbers))[:, None]
    places = np.concatenate([starts[: -3 * spacing] + spacing * np.arange(4) for spacing in SPACINGS])
    places = places[numbers[places[:, 0]] == numbers[places[:, -1]]]
    apart = times[places][:, :, None] - times[places][:, None]
    factors = 1 / np.prod(apart + np.eye(4), axis=-1)  # of the divided difference
    return Windows(places, factors / np.linalg.norm(factors, axis=-1, keepdims=True))


def parallax_terms(
    windows: Windows,
    distances: Float[np.ndarray, " O"],
    centres: Float[np.ndarray, "O 3"],
    rays: Float[np.ndarray, "O 3"],
    focal_length: float,
) -> tuple[sparse.csr_array, Float[np.ndarray, " _"]]:
    """Rows of a least-squares problem in log-distances, and their right-hand sides.

    A smooth path has third differences near 0, a shaking camera has not. Seen from the camera, the path then has them,
    too, in proportion to 1 / distance. Those across the line of sight are measured; which distance, common to a window,
    explains them best is a matter of linear regression, whatever else there is in the path as long as it does not
    depend on the camera's shaking. Absolute errors count, by reweighted least squares around the given distances.

    Args:
        windows: of the observations.
        distances: logarithms of the present ones.
        centres: of the cameras, world units.
        rays: from there, per unit of distance.
        focal_length: of the cameras, pixels.
    """
    places, factors = windows
    common = distances[places].mean(-1, keepdims=True)
    of_camera = np.exp(-common) * np.einsum("wk,wkc->wc", factors, centres[places])
    of_rays = np.einsum("wk,wkc->wc", factors * np.exp(distances[places] - common), rays[places])
    sight = rays[places[:, 1]] / np.linalg.norm(rays[places[:, 1]], axis=-1, keepdims=True)
    shaking, error = (x - (x * sight).sum(-1, keepdims=True) * sight for x in (of_camera, of_camera + of_rays))
    deviations = np.linalg.norm(error, axis=-1, keepdims=True) * focal_length / PATH_SIGMA
    scale = np.sqrt(WEIGHT / np.maximum(deviations, 1)) * focal_length / PATH_SIGMA
    slope, error = (-scale * shaking).ravel(), (scale * error).ravel()  # slope with respect to the common distance
    rows, columns = np.arange(len(slope)).repeat(4), places.repeat(3, axis=0).ravel()
    terms = sparse.csr_array((slope.repeat(4) / 4, (rows, columns)), (len(slope), len(distances)))
    return terms, slope * common.repeat(3) - error
