"""Depths of tracks: near those of the scene's points around them, and similar for tracks that move alike."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy import sparse
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

from l2dgs_jax.cameras.geometry import project_points
from l2dgs_jax.training.tracks import DEPTH_CELL, Tracks

NEIGHBOURS = 30  # nearest points of a pixel that depths are taken from
STATIC_QUANTILES = 0.03, 0.97  # of their depths, between which static surfaces may lie: a few points are outliers
CANDIDATES = 4  # depths in that range, evenly spaced in inverse depth
MOVING_QUANTILE = 0.08  # of their depths, the one assumed for what moves
BORDER = 20  # pixels beyond the image in which points still count
NEIGHBOUR_RADIUS = 9.0  # pixels within which tracks may belong to one object
VELOCITY_SIGMA = 0.5  # standard deviation, in pixels per frame, of velocities within one object
# Weights of squared differences of log-depths, relative to those from the depths of the points around
NEIGHBOUR_WEIGHT = 10.0  # between neighbours, times the similarity of their motion
CURVATURE_WEIGHT = 100.0  # second differences along a track
CHANGE_WEIGHT = 1.0  # first differences along a track


class Depths(NamedTuple):
    """Depths that the points around each cell of F frames suggest, world units; NaN in frames that show no points.

    Attributes:
        still: C candidates for static surfaces, the nearest first.
        moving: for what moves, which occludes the points around and so lies in front of most.
    """

    still: Float32[np.ndarray, "C *F h w"]
    moving: Float32[np.ndarray, "*F h w"]


def depths_around(
    points: Float[np.ndarray, "P 3"],
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    height: int,
    width: int,
) -> Depths:
    """Depths in one frame, of points in world units."""
    pixels, depth = project_points(points, viewmat, K)
    inside = ((pixels > -BORDER) & (pixels < (width + BORDER, height + BORDER))).all(-1)
    rows, columns = (np.arange(0, size, DEPTH_CELL) + 0.5 * DEPTH_CELL for size in (height, width))
    if not inside.any():
        unknown = np.full((1 + CANDIDATES, len(rows), len(columns)), np.nan, np.float32)
        return Depths(unknown[1:], unknown[0])
    cells = np.stack(np.meshgrid(columns, rows), axis=-1)
    _, around = cKDTree(pixels[inside]).query(cells, k=range(1, min(NEIGHBOURS, int(inside.sum())) + 1))
    low, high = STATIC_QUANTILES
    near, front, far = np.quantile(depth[inside][around], (low, MOVING_QUANTILE, high), axis=-1)
    return Depths((1 / np.linspace(1 / near, 1 / far, CANDIDATES)).astype(np.float32), front.astype(np.float32))


def depths_at(tracks: Tracks, depths: Float32[np.ndarray, "F h w"]) -> Float32[np.ndarray, " O"]:
    """Depths of the cells that the observations of tracks lie in."""
    columns, rows = (tracks.pixels // DEPTH_CELL).astype(int).T
    return depths[tracks.frames, rows, columns]


def shared_depths(tracks: Sequence[Tracks], depths: Float32[np.ndarray, "F h w"]) -> list[Float[np.ndarray, " O"]]:
    """Depths of all observations of the tracks, solved for jointly, world units.

    They are near those of the cells, change smoothly along a track, and are similar where neighbours in a frame move
    alike: the points around an object show its surroundings, and give different depths to its parts and instants.

    Args:
        tracks: at least one, each with at least one observation in a cell of known depth.
        depths: of the cells, NaN where unknown.
    """
    lengths = [len(track.frames) for track in tracks]
    merged = Tracks(*(np.concatenate(parts) for parts in zip(*tracks, strict=True)))
    prior = np.log(np.concatenate([depths_at(track, depths) for track in tracks]).astype(np.float64))
    known = np.isfinite(prior)
    prior = np.where(known, prior, prior[known].mean())
    owner = np.repeat(np.arange(len(tracks)), lengths)

    first, second, similarity = _neighbours(merged, np.concatenate([_velocities(track.pixels) for track in tracks]))
    steps, bends = (np.flatnonzero(owner[n:] == owner[:-n]) for n in (1, 2))
    count = len(prior)
    terms = (
        _differences(count, (first, second), (1, -1), NEIGHBOUR_WEIGHT * similarity),
        _differences(count, (steps, steps + 1), (1, -1), CHANGE_WEIGHT),
        _differences(count, (bends, bends + 1, bends + 2), (1, -2, 1), CURVATURE_WEIGHT),
    )
    normal = sparse.diags_array(known.astype(float)) + sum(term.T @ term for term in terms)
    found, _ = cg(normal.tocsr(), known * prior, x0=prior, rtol=1e-4, maxiter=500)
    return np.split(np.exp(found), np.cumsum(lengths)[:-1])


def _velocities(pixels: Float[np.ndarray, "O 2"]) -> Float[np.ndarray, "O 2"]:
    """Pixels from each observation of a track to the next one; the last repeats the one before."""
    steps = np.diff(pixels, axis=0)
    return np.concatenate([steps, steps[-1:]])


def _neighbours(
    tracks: Tracks, velocities: Float[np.ndarray, "O 2"]
) -> tuple[Int[np.ndarray, " E"], Int[np.ndarray, " E"], Float[np.ndarray, " E"]]:
    """Pairs of observations that are close to each other in a frame, and how similarly they move, in (0, 1]."""
    by_frame = np.argsort(tracks.frames, kind="stable")
    groups = np.split(by_frame, np.flatnonzero(np.diff(tracks.frames[by_frame])) + 1)
    close = lambda pixels: cKDTree(pixels).query_pairs(NEIGHBOUR_RADIUS, output_type="ndarray")
    pairs = [group[close(tracks.pixels[group])] for group in groups]
    first, second = np.concatenate(pairs).T
    squared = np.square(velocities[first] - velocities[second]).sum(-1)
    return first, second, np.exp(-squared / (2 * VELOCITY_SIGMA**2))


def _differences(
    count: int,
    places: Sequence[Int[np.ndarray, " E"]],
    factors: Sequence[int],
    weights: Float[np.ndarray, " E"] | float,
) -> sparse.csr_array:
    """E rows of a least-squares problem in `count` unknowns, of linear combinations of the unknowns at `places`."""
    number, roots = len(places[0]), np.sqrt(weights)
    values = np.concatenate([np.broadcast_to(factor * roots, number) for factor in factors])
    rows = np.tile(np.arange(number), len(places))
    return sparse.csr_array((values, (rows, np.concatenate(places))), (number, count))
