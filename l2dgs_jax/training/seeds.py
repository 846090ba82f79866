"""Gaussians to begin with on what moves, each with the path that its track tells.

Points from structure from motion are of what stands still. A motion field that starts from rest must then first find
out which of them to carry where; tracks of optical flow say so before training begins.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32

from l2dgs_jax.cameras.geometry import camera_centres, project_points
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.model.deformation import path_weights
from l2dgs_jax.model.initialisation import Seeds, path_knots, z_order
from l2dgs_jax.training.depths import depths_around, depths_at, shared_depths
from l2dgs_jax.training.flows import neighbour_flows
from l2dgs_jax.training.tracks import SPACING, Tracks, find_tracks

SHORTEST = 3  # frames that a track must be seen in
MOVING = 0.4  # part of them in which it must be seen to move
STRAY = 3.0  # pixels by which it must leave where any still point would be seen
STIFFNESS = 1e-3  # weight of the squared bends of a path against squared distances from what was tracked


def find_seeds(points: Float[np.ndarray, "P 3"], split: Split, most: int) -> Seeds:
    """Seeds on what moves between the frames; none where flow cannot tell.

    Args:
        points: of the scene, world units.
        split: the frames.
        most: how many seeds there may be; the tracks seen longest come first.
    """
    cameras = _Cameras(*(np.asarray(x, np.float64) for x in split.cameras))
    height, width = split.images.shape[1:3]
    around = [depths_around(points, *camera[:2], height, width) for camera in zip(*cameras, strict=True)]
    still = np.stack([depths.still for depths in around], axis=1)
    tracks = find_tracks(split, neighbour_flows(split), still)
    knots = path_knots(len(cameras.time))
    weights = np.asarray(path_weights(jnp.asarray(cameras.time), knots))
    chosen = _worthwhile(tracks, cameras, still, most)
    if not chosen:
        shapes = ((0, 3), (0, 3), (0,), (0, knots, 3), (0, 2))
        return Seeds(*(np.zeros(shape, np.float32) for shape in shapes))
    depths = shared_depths(chosen, np.stack([depths.moving for depths in around]))
    seeds = [_seed(split, cameras, weights, *track) for track in zip(chosen, depths, strict=True)]
    found = Seeds(*(np.array(rows, np.float32) for rows in zip(*seeds, strict=True)))
    order = z_order(found.points)
    return Seeds(*(rows[order] for rows in found))


class _Cameras(NamedTuple):
    """A `Camera` of double precision in NumPy."""

    viewmat: Float[np.ndarray, "F 4 4"]
    K: Float[np.ndarray, "F 3 3"]
    time: Float[np.ndarray, " F"]


def _worthwhile(tracks: Tracks, cameras: _Cameras, depths: Float32[np.ndarray, "C F h w"], most: int) -> list[Tracks]:
    """The tracks, apart, that are long enough and lead away from where they would if their start stood still."""
    starts = np.flatnonzero(np.diff(tracks.numbers, prepend=-1))
    lengths = np.diff(starts, append=len(tracks.numbers))
    if not len(starts):
        return []
    strays, viewmats, Ks = [], cameras.viewmat[tracks.frames], cameras.K[tracks.frames]
    for depth in depths:
        world = np.repeat(_lift(tracks, cameras, depths_at(tracks, depth))[starts], lengths, axis=0)
        still, _ = project_points(world, viewmats, Ks)
        strays.append(np.maximum.reduceat(np.linalg.norm(tracks.pixels - still, axis=-1), starts))
    moves = np.add.reduceat(tracks.moves, starts) / lengths
    strayed = np.min(strays, axis=0) > STRAY  # not where a depth is NaN
    worth = np.flatnonzero((lengths >= SHORTEST) & (moves > MOVING) & strayed)
    chosen = worth[np.argsort(-lengths[worth], kind="stable")[:most]]
    return [Tracks(*(x[starts[i] : starts[i] + lengths[i]] for x in tracks)) for i in chosen]


def _seed(
    split: Split,
    cameras: _Cameras,
    weights: Float[np.ndarray, "F K"],
    track: Tracks,
    depth: Float[np.ndarray, " O"],
) -> Seeds:
    """What one track says, the middle of it being where the Gaussian is."""
    frames, instants = track.frames, np.unique(cameras.time)
    times = cameras.time[frames]
    way, middle = _lift(track, cameras, depth), len(frames) // 2
    # It is there half of the time to the frames in which it is seen no more.
    first, last = np.searchsorted(instants, times[[0, -1]]).tolist()
    before, after = instants[max(first - 1, 0)], instants[min(last + 1, len(instants) - 1)]
    columns, rows = track.pixels.astype(int).T
    return Seeds(
        points=way[middle],
        colors=np.median(split.images[frames, rows, columns], axis=0),
        spacings=SPACING * depth[middle] / cameras.K[frames[middle], 0, 0],
        paths=_fitted(weights[frames], way - way[middle]),
        lifetimes=np.array([before + times[0], times[-1] + after]) / 2,
    )


def _fitted(weights: Float[np.ndarray, "O K"], places: Float[np.ndarray, "O 3"]) -> Float[np.ndarray, "K 3"]:
    """Control points of the straightest path, nearly through those places; beyond them it goes on as it went."""
    bends = np.diff(np.eye(weights.shape[1]), 2, axis=0)
    stiff = weights.T @ weights + STIFFNESS * bends.T @ bends
    return np.linalg.solve(stiff, weights.T @ places)


def _lift(tracks: Tracks, cameras: _Cameras, depth: Float[np.ndarray, " O"]) -> Float[np.ndarray, "O 3"]:
    """World points of observations at those depths."""
    viewmat, K = cameras.viewmat[tracks.frames], cameras.K[tracks.frames]
    homogeneous = np.concatenate([tracks.pixels, np.ones((len(depth), 1))], axis=-1)
    rays = np.einsum("oij,oj->oi", np.linalg.inv(K), homogeneous)
    return camera_centres(viewmat) + np.einsum("oji,oj->oi", viewmat[:, :3, :3], depth[:, None] * rays)
