"""How far away tracks are: as the nearest points around them, and alike for what moves alike."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy import sparse
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

from l2dgs_jax.cameras.geometry import project_points
from l2dgs_jax.training.tracks import DEPTH_CELL, Tracks

NEIGHBOURS = 30  # points around a pixel that depths are taken from
RANGE = 0.03, 0.97  # quantiles of their depths between which what stands still may be, as a few points lie astray
GUESSES = 4  # of a depth in that range
FRONT = 0.08  # quantile that what moves is at
BESIDE = 20  # pixels beyond the border in which points still count
TOGETHER = 9.0  # pixels within which tracks may be of one thing
ALIKE = 0.5  # standard deviation, in pixels a frame, of motions within one thing
# Weights against squared differences from the depths of the points around, all of logarithms
SHARED = 10.0  # of differences between neighbours that move alike
EVEN = 100.0  # of second differences along a track
STEADY = 1.0  # of first ones


class Depths(NamedTuple):
    """Depths that the points around each cell of F frames have, world units; NaN where none are in view.

    Attributes:
        still: C guesses for what stands still, the nearest first.
        moving: for what moves and therefore hides the others.
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
    inside = ((pixels > -BESIDE) & (pixels < (width + BESIDE, height + BESIDE))).all(-1)
    rows, columns = (np.arange(0, size, DEPTH_CELL) + 0.5 * DEPTH_CELL for size in (height, width))
    if not inside.any():
        unknown = np.full((1 + GUESSES, len(rows), len(columns)), np.nan, np.float32)
        return Depths(unknown[1:], unknown[0])
    cells = np.stack(np.meshgrid(columns, rows), axis=-1)
    _, around = cKDTree(pixels[inside]).query(cells, k=range(1, min(NEIGHBOURS, int(inside.sum())) + 1))
    near, front, far = np.quantile(depth[inside][around], (RANGE[0], FRONT, RANGE[1]), axis=-1)
    return Depths((1 / np.linspace(1 / near, 1 / far, GUESSES)).astype(np.float32), front.astype(np.float32))


def depths_at(tracks: Tracks, depths: Float32[np.ndarray, "F h w"]) -> Float32[np.ndarray, " O"]:
    """Depths of the cells that the observations of tracks lie in."""
    columns, rows = (tracks.pixels // DEPTH_CELL).astype(int).T
    return depths[tracks.frames, rows, columns]


def shared_depths(tracks: Sequence[Tracks], depths: Float32[np.ndarray, "F h w"]) -> list[Float[np.ndarray, " O"]]:
    """Depths of all observations of at least one track at once, world units; each track has one in a known cell.

    They are near those of the cells, change evenly along a track, and are alike where neighbours in a frame move
    alike: the points around tell of a thing's surroundings, and differently at each of its spots and instants.
    """
    lengths = [len(track.frames) for track in tracks]
    every = Tracks(*(np.concatenate(parts) for parts in zip(*tracks, strict=True)))
    told = np.log(np.concatenate([depths_at(track, depths) for track in tracks]).astype(np.float64))
    known = np.isfinite(told)
    told = np.where(known, told, told[known].mean())
    owner = np.repeat(np.arange(len(tracks)), lengths)

    first, second, alike = _neighbours(every, np.concatenate([_velocities(track.pixels) for track in tracks]))
    steps, bends = (np.flatnonzero(owner[n:] == owner[:-n]) for n in (1, 2))
    count = len(told)
    terms = (
        _differences(count, (first, second), (1, -1), SHARED * alike),
        _differences(count, (steps, steps + 1), (1, -1), STEADY),
        _differences(count, (bends, bends + 1, bends + 2), (1, -2, 1), EVEN),
    )
    normal = sparse.diags_array(known.astype(float)) + sum(term.T @ term for term in terms)
    found, _ = cg(normal.tocsr(), known * told, x0=told, rtol=1e-4, maxiter=500)
    return np.split(np.exp(found), np.cumsum(lengths)[:-1])


def _velocities(pixels: Float[np.ndarray, "O 2"]) -> Float[np.ndarray, "O 2"]:
    """Pixels from each observation of a track to the next one; the last goes on as it came."""
    steps = np.diff(pixels, axis=0)
    return np.concatenate([steps, steps[-1:]])


def _neighbours(
    tracks: Tracks, velocities: Float[np.ndarray, "O 2"]
) -> tuple[Int[np.ndarray, " E"], Int[np.ndarray, " E"], Float[np.ndarray, " E"]]:
    """Pairs of observations that are close to each other in a frame, and how alike they move, in (0, 1]."""
    by_frame = np.argsort(tracks.frames, kind="stable")
    groups = np.split(by_frame, np.flatnonzero(np.diff(tracks.frames[by_frame])) + 1)
    pairs = [group[cKDTree(tracks.pixels[group]).query_pairs(TOGETHER, output_type="ndarray")] for group in groups]
    first, second = np.concatenate(pairs).T
    apart = np.square(velocities[first] - velocities[second]).sum(-1)
    return first, second, np.exp(-apart / (2 * ALIKE**2))


def _differences(
    count: int,
    places: Sequence[Int[np.ndarray, " E"]],
    factors: Sequence[int],
    weights: Float[np.ndarray, " E"] | float,
) -> sparse.csr_array:
    """E rows of a least-squares problem in `count` unknowns: factors times the unknowns at those places."""
    number, roots = len(places[0]), np.sqrt(weights)
    values = np.concatenate([np.broadcast_to(factor * roots, number) for factor in factors])
    rows = np.tile(np.arange(number), len(places))
    return sparse.csr_array((values, (rows, np.concatenate(places))), (number, count))
