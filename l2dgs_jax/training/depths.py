"""Depths of tracks: as given, or of the surface that an object stands on, corrected by parallax."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, cg, splu
from scipy.spatial import cKDTree

from l2dgs_jax.training import parallax
from l2dgs_jax.training.tracks import Tracks, by_frame, by_track

NEIGHBOUR_RADIUS = 9.0  # pixels within which tracks may belong to one object
VELOCITY_SIGMA = 0.004  # standard deviation of velocities within one object, in focal lengths per frame
MIN_VELOCITY_SIGMA = 0.75  # at least this, pixels per frame: flow has errors
ALIKE = 0.5  # similarity of motion from which neighbours belong to one object
PAIRS = 20_000  # pairs of tracks that are compared at a time
COLUMNS = 0.03  # distance to either side in which what an object hides counts, in focal lengths
MIN_COLUMNS = 6.0  # at least this distance, pixels
# Weights of squared differences of log-distances; the absolute error of the guess counts `TYPICAL_ERROR` times
NEIGHBOUR_WEIGHT = 1.0  # between neighbours, times the similarity of their motion
CURVATURE_WEIGHT = 1000.0  # second differences along a track
CHANGE_WEIGHT = 30.0  # first differences along a track
UNKNOWN_WEIGHT = 1e-3  # where nothing is known, compared with a guess: what else is known about a track then decides
GIVEN_WEIGHT = 10.0  # depth that came with the scene, compared with a guess
FLOATING_WEIGHT = 0.3  # being nearer than a guess that comes from no foot
TYPICAL_ERROR = 0.1  # of the guess, in log-distance
SMALL_ERROR = 0.02  # below which errors of the guess count as squares
ITERATIONS = 15
STEP_TOLERANCE = 1e-3  # of the residual, in each of them


class Sights(NamedTuple):
    """What cameras and scene tell about the O observations of tracks, in their order; depths are NaN where unknown.

    Attributes:
        times: at which they are made.
        centres: of the cameras, world units.
        rays: from there through the pixels, per unit of depth.
        horizontal: horizontal distance per unit of depth, positive; 1 for all if it is unknown where up is.
        hidden: depth of the surface that something there would hide, world units.
        foot: if they are feet of objects, depth of the ground that the ends of these hide, world units.
        given: depth that came with the scene, world units.
    """

    times: Float[np.ndarray, " O"]
    centres: Float[np.ndarray, "O 3"]
    rays: Float[np.ndarray, "O 3"]
    horizontal: Float[np.ndarray, " O"]
    hidden: Float[np.ndarray, " O"]
    foot: Float[np.ndarray, " O"]
    given: Float[np.ndarray, " O"]


def shared_depths(
    tracks: Tracks, sights: Sights, below: Int[np.ndarray, "2 E"], focal_length: float
) -> Float[np.ndarray, " O"]:
    """Depths of all observations of the tracks, solved for jointly, world units.

    Solved for are horizontal distances, because they are the same for all parts of an upright object. Most objects
    stand on something, which is what their feet hide. Where no depth is given, the first guess is the nearest foot of
    the object; if it shows none, the distance of what is just below it, such as legs below a trunk that moves
    otherwise; or else the nearest of all that it hides: then it may be nearer at little cost. The guess is also wrong
    where what seems to be one object is several; so the solution may depart from it, as far as parallax tells, and
    changes smoothly along a track and between neighbours that move alike.

    Args:
        tracks: at least one observation lies in a cell of known depth.
        sights: what cameras and scene tell about them.
        below: pairs of observations of one frame, of which the second is just below the first.
        focal_length: of the cameras, pixels: how far apart and how fast things are is judged by angles.
    """
    pairs = _neighbours(tracks)
    similarity = _similarity(pairs, tracks, max(MIN_VELOCITY_SIGMA, VELOCITY_SIGMA * focal_length))
    width = max(MIN_COLUMNS, COLUMNS * focal_length)
    guess = _first_guess(tracks, sights, below, pairs[:, similarity > ALIKE], width)
    along = _along_tracks(tracks)
    smoothness = along + _quadratic(
        _combinations(len(tracks.numbers), tuple(pairs), (1, -1), NEIGHBOUR_WEIGHT * similarity)
    )
    rays = sights.rays / sights.horizontal[:, None]
    windows = parallax.find_windows(tracks.numbers, sights.times, sights.centres, rays)
    mean = _combinations(len(rays), tuple(windows.places.T), (0.25,) * 4, 1.0)
    found = guess.logs
    for _ in range(ITERATIONS):  # least absolute errors by reweighted least squares
        weights = guess.trust / np.maximum(np.abs(found - guess.logs), SMALL_ERROR)
        weights = np.where(guess.floats & (found < guess.logs), FLOATING_WEIGHT, 1) * weights
        shaking, certainty = parallax.estimates(windows, found, focal_length)
        normal = (sparse.diags_array(weights) + smoothness + mean.T @ sparse.diags_array(certainty) @ mean).tocsr()
        residual = weights * (guess.logs - found) - smoothness @ found + mean.T @ (certainty * (shaking - mean @ found))
        # Solving for the step makes its accuracy independent of the scene's unit. What is left if it has not converged
        # is part of the next one.
        step, _ = cg(normal, residual, rtol=STEP_TOLERANCE, maxiter=500, M=_preconditioner(normal, along))
        found = found + step
    return np.exp(found) / sights.horizontal


class _Guess(NamedTuple):
    """The first guess of horizontal distances.

    Attributes:
        logs: of the distances.
        trust: weights of their absolute errors; small where nothing is known, and the guess is the mean of all others.
        floats: whether it comes from no foot.
    """

    logs: Float[np.ndarray, " O"]
    trust: Float[np.ndarray, " O"]
    floats: Bool[np.ndarray, " O"]


def _first_guess(
    tracks: Tracks, sights: Sights, below: Int[np.ndarray, "2 B"], alike: Int[np.ndarray, "2 E"], width: float
) -> _Guess:
    """Given distances, or the nearest that the feet of objects or, where there are none, all of their parts hide.

    Args:
        tracks: their observations.
        sights: what is known about them.
        below: pairs of observations, of which the second is just below the first.
        alike: pairs of observations that move alike.
        width: of the columns in which objects hide what counts, to either side.
    """
    hidden, foot, given = (sights.horizontal * x for x in (sights.hidden, sights.foot, sights.given))
    stands = _nearest(tracks, foot, alike, width)
    rests = _resting(tracks, below, np.where(np.isnan(foot), np.nan, stands))
    stands = np.where(np.isnan(stands), rests, stands)
    guess = np.where(np.isnan(stands), _nearest(tracks, hidden, alike, width), stands)
    is_given = np.isfinite(given)
    logs = np.log(np.where(is_given, given, guess))
    known = np.isfinite(logs)
    trust = TYPICAL_ERROR * np.where(known, 1, UNKNOWN_WEIGHT) * np.where(is_given, GIVEN_WEIGHT, 1)
    return _Guess(np.where(known, logs, logs[known].mean()), trust, np.isnan(stands) & ~is_given)


def _resting(tracks: Tracks, below: Int[np.ndarray, "2 E"], feet: Float[np.ndarray, " O"]) -> Float[np.ndarray, " O"]:
    """Distances from the feet upwards: of what is just below, and of the farthest, as others may be in front of it.

    They are NaN for what has no foot below it, and in `feet` for what is none.
    """
    distances = feet.copy()
    upper, lower = below[:, np.argsort(below[0], kind="stable")]
    firsts = np.searchsorted(upper, np.arange(len(distances) + 1))
    for i in np.argsort(-tracks.pixels[:, 1], kind="stable"):  # from the bottom up
        if np.isnan(distances[i]) and firsts[i] < firsts[i + 1]:
            distances[i] = np.fmax.reduce(distances[lower[firsts[i] : firsts[i + 1]]])
    return distances


def _along_tracks(tracks: Tracks) -> sparse.csr_array:
    """The quadratic form of how much log-distances change along tracks."""
    steps, bends = (np.flatnonzero(tracks.numbers[n:] == tracks.numbers[:-n]) for n in (1, 2))
    count = len(tracks.numbers)
    changes = _combinations(count, (steps, steps + 1), (1, -1), CHANGE_WEIGHT)
    curvature = _combinations(count, (bends, bends + 1, bends + 2), (1, -2, 1), CURVATURE_WEIGHT)
    return _quadratic(changes) + _quadratic(curvature)


def _quadratic(combinations: sparse.csr_array) -> sparse.csr_array:
    return (combinations.T @ combinations).tocsr()


def _preconditioner(normal: sparse.csr_array, along: sparse.csr_array) -> LinearOperator:
    """The inverse of the part of the normal equations within tracks, which are long and stiff, and of the diagonal."""
    rest = np.maximum(normal.diagonal() - along.diagonal(), np.finfo(float).eps * normal.diagonal())
    factors = splu((along + sparse.diags_array(rest)).tocsc(), permc_spec="NATURAL")
    return LinearOperator(normal.shape, factors.solve)


def _nearest(
    tracks: Tracks, distances: Float[np.ndarray, " O"], alike: Int[np.ndarray, "2 E"], width: float
) -> Float[np.ndarray, " O"]:
    """For each observation, the least distance of its object up to `width` pixels to either side; NaN if all are.

    An object is what pairs of observations of one frame connect.
    """
    count = len(distances)
    _, objects = connected_components(sparse.coo_array((np.ones(alike.shape[1]), alike), (count, count)), False)
    columns = tracks.pixels[:, 0]
    nearest = np.empty(count)
    for group in by_frame(tracks):
        group = group[np.argsort(objects[group], kind="stable")]
        for part in np.split(group, np.flatnonzero(np.diff(objects[group])) + 1):
            part = part[np.argsort(columns[part])]
            start = np.searchsorted(columns[part], columns[part] - width)
            stop = np.searchsorted(columns[part], columns[part] + width, side="right")
            around = np.stack([start, stop], axis=-1).ravel()  # every other one of these slices is wanted
            nearest[part] = np.fmin.reduceat(np.append(distances[part], np.nan), around)[::2]
    return nearest


def _neighbours(tracks: Tracks) -> Int[np.ndarray, "2 E"]:
    """Pairs of observations that are close to each other in a frame."""
    close = lambda pixels: cKDTree(pixels).query_pairs(NEIGHBOUR_RADIUS, output_type="ndarray")
    return np.concatenate([group[close(tracks.pixels[group])] for group in by_frame(tracks)]).T


def _similarity(pairs: Int[np.ndarray, "2 E"], tracks: Tracks, sigma: float) -> Float[np.ndarray, " E"]:
    """How similarly pairs of observations move, in (0, 1], as long as both their tracks are seen.

    At an instant, things that are near each other in the picture may well move alike by chance.
    """
    _, numbers = np.unique(tracks.numbers, return_inverse=True)
    count = numbers.max() + 1
    velocities = np.full((count, tracks.frames.max() + 1, 2), np.nan, np.float32)
    velocities[numbers, tracks.frames] = np.concatenate([_velocities(x) for x in by_track(tracks, tracks.pixels)])
    first, second = numbers[pairs]
    which, places = np.unique(first * count + second, return_inverse=True)
    parts = np.split(which, range(PAIRS, len(which), PAIRS))
    squares = [np.square(velocities[part // count] - velocities[part % count]).sum(-1) for part in parts]
    return np.exp(-np.concatenate([np.nanmean(x, axis=1) for x in squares])[places] / (2 * sigma**2))


def _velocities(pixels: Float[np.ndarray, "O 2"]) -> Float[np.ndarray, "O 2"]:
    """Pixels per frame from each observation of a track to its next; the last repeats the one before."""
    steps = np.diff(pixels, axis=0)
    return np.concatenate([steps, steps[-1:]])


def _combinations(
    count: int,
    places: Sequence[Int[np.ndarray, " E"]],
    factors: Sequence[int | float],
    weights: Float[np.ndarray, " E"] | float,
) -> sparse.csr_array:
    """E rows of a least-squares problem in `count` unknowns, of linear combinations of the unknowns at `places`."""
    number, roots = len(places[0]), np.sqrt(weights)
    values = np.concatenate([np.broadcast_to(factor * roots, number) for factor in factors])
    rows = np.tile(np.arange(number), len(places))
    return sparse.csr_array((values, (rows, np.concatenate(places))), (number, count))
