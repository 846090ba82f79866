"""Initial Gaussians on moving things, each with a path fitted to a track of optical flow.

Points from structure from motion lie on static surfaces. A motion field that starts from rest would first have to find
out which of them to move where; tracks of optical flow tell before training begins.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from l2dgs_jax.cameras.geometry import camera_centres, pixel_rays
from l2dgs_jax.cameras.ground import TOLERANCE, horizontal_per_depth
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.model.deformation import path_weights
from l2dgs_jax.model.initialisation import Seeds, z_order
from l2dgs_jax.training.backdrop import (
    Backdrop,
    Cameras,
    find_backdrop,
    floor_depths,
    hidden_depths,
    unprojected,
)
from l2dgs_jax.training.background import likeness_to_background
from l2dgs_jax.training.depths import Sights, shared_depths
from l2dgs_jax.training.feet import find_feet, find_soles, just_below
from l2dgs_jax.training.given_depth import in_world_units
from l2dgs_jax.training.moving_tracks import moving_tracks
from l2dgs_jax.training.tracks import SPACING, Tracks, by_track, share_in_track

MIN_HORIZONTAL = 0.2  # horizontal distance per unit of depth below which a camera looks down too steeply
BACKGROUND_SHARE = 0.5  # share of a track's observations, from which on it is the background that the track shows
STIFFNESS = 1e-3  # weight of squared second differences of a path, relative to squared distances from the track


def find_seeds(
    points: Float[np.ndarray, "P 3"], split: Split, knots: int, most: int, tolerance: float = TOLERANCE
) -> Seeds:
    """Seeds on what moves between the frames; none where no flow can be trusted.

    If the scene has depth maps, they tell how far away the seeds are, after being fitted to the points.

    Args:
        points: of the scene, world units.
        split: the frames.
        knots: control points of a path.
        most: how many seeds there may be; the longest tracks come first.
        tolerance: of `find_ground`.
    """
    height, width = split.images.shape[1:3]
    backdrop = find_backdrop(points, split.cameras, height, width, tolerance)
    split, backdrop, chosen = moving_tracks(split, backdrop, most)
    cameras = backdrop.cameras
    weights = np.asarray(path_weights(jnp.asarray(cameras.time), knots))
    if not len(chosen.numbers):
        shapes = ((0, 3), (0, 3), (0,), (0, knots, 3), (0, 2))
        return Seeds(*(np.zeros(shape, np.float32) for shape in shapes))
    depths = _depths(chosen, split, backdrop, _given_depths(chosen, cameras, points, split))
    parts = zip(*(by_track(chosen, x) for x in (*chosen, depths)), strict=True)
    seeds = [_seed(split, cameras, weights, Tracks(*track), depth) for *track, depth in parts]
    found = Seeds(*(np.array(rows, np.float32) for rows in zip(*seeds, strict=True)))
    order = z_order(found.points)
    return Seeds(*(rows[order] for rows in found))


def _depths(
    tracks: Tracks, split: Split, backdrop: Backdrop, given: Float[np.ndarray, " O"]
) -> Float[np.ndarray, " O"]:
    """Depths of the observations, world units; tracks that show the background lie on it."""
    depths = hidden_depths(backdrop, tracks.frames, tracks.pixels)

    def is_background(frames: Int[np.ndarray, " N"], pixels: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, " N"]:
        return likeness_to_background(frames, pixels, split, backdrop, tracks).alike

    background = is_background(tracks.frames, tracks.pixels)
    shows_background = share_in_track(tracks, background) > BACKGROUND_SHARE
    others = ~shows_background | (share_in_track(tracks, np.isnan(depths)) > 0)
    if np.isfinite(depths[others]).any():
        moving = Tracks(*(x[others] for x in tracks))
        focal_x, focal_y = backdrop.cameras.K[:, [0, 1], [0, 1]].mean(0).tolist()
        height = split.images.shape[1]
        foreground = ~background[others]
        below = just_below(moving, foreground)
        feet = find_feet(moving, foreground, below, height)
        frames = moving.frames[feet]
        soles = find_soles(frames, moving.pixels[feet], is_background, focal_y, height)
        foot = np.full(len(feet), np.nan)
        foot[feet] = floor_depths(backdrop, frames, soles)
        sights = _sights(moving, backdrop, depths[others], foot, given[others])
        depths[others] = shared_depths(moving, sights, below, focal_x)
    return depths


def _seed(
    split: Split,
    cameras: Cameras,
    weights: Float[np.ndarray, "F K"],
    track: Tracks,
    depth: Float[np.ndarray, " O"],
) -> Seeds:
    """The seed of one track, whose middle observation becomes the canonical centre."""
    frames, instants = track.frames, np.unique(cameras.time)
    times = cameras.time[frames]
    positions, middle = unprojected(cameras, frames, track.pixels, depth), len(frames) // 2
    # The lifetime extends halfway to the neighbouring instants, at which the track is not seen, and to the end of time
    # where no frame says so.
    limits = np.concatenate([[0.0], (instants[:-1] + instants[1:]) / 2, [1.0]])
    first, last = np.searchsorted(instants, times[[0, -1]]).tolist()
    columns, rows = track.pixels.astype(int).T
    return Seeds(
        points=positions[middle],
        colors=np.median(split.images[frames, rows, columns], axis=0),
        spacings=SPACING * depth[middle] / cameras.K[frames[middle], 0, 0],
        paths=_fitted_path(weights[frames], positions - positions[middle]),
        lifetimes=limits[[first, last + 1]],
    )


def _fitted_path(weights: Float[np.ndarray, "O K"], places: Float[np.ndarray, "O 3"]) -> Float[np.ndarray, "K 3"]:
    """Control points of a smoothing spline through those places; beyond them it goes on straight."""
    second_differences = np.diff(np.eye(weights.shape[1]), 2, axis=0)
    normal = weights.T @ weights + STIFFNESS * second_differences.T @ second_differences
    return np.linalg.solve(normal, weights.T @ places)


def _sights(tracks: Tracks, backdrop: Backdrop, *known: Shaped[np.ndarray, " O"]) -> Sights:
    """What cameras and scene tell about the observations, of which the last fields of `Sights` are known.

    Where cameras look too steeply, horizontal distances are treated as unknown.
    """
    cameras, frames = backdrop.cameras, tracks.frames
    viewmat, K, horizontal = cameras.viewmat[frames], cameras.K[frames], np.ones(len(frames))
    if backdrop.ground is not None:
        per_depth = horizontal_per_depth(tracks.pixels, viewmat, K, backdrop.ground.up)
        horizontal = per_depth if per_depth.min() > MIN_HORIZONTAL else horizontal
    rays = pixel_rays(tracks.pixels, viewmat, K)
    return Sights(cameras.time[frames], camera_centres(viewmat), rays, horizontal, *known)


def _given_depths(
    tracks: Tracks, cameras: Cameras, points: Float[np.ndarray, "P 3"], split: Split
) -> Float[np.ndarray, " O"]:
    """The scene's own depth at the observations, world units; NaN where it has none."""
    columns, rows = tracks.pixels.astype(int).T
    depths = np.full(len(tracks.frames), np.nan)
    if split.depths is not None:
        for frame in np.unique(tracks.frames):
            here = tracks.frames == frame
            depth = in_world_units(split.depths[frame], points, cameras.viewmat[frame], cameras.K[frame])
            depths[here] = depth[rows[here], columns[here]]
    return depths
