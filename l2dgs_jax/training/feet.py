"""Feet: the lowest parts of moving things, which tell where these stand."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from l2dgs_jax.training.tracks import Tracks, by_frame

BELOW = 1.5, 9.0  # pixels from an observation down to another one that counts as just below it
BESIDE = 4.5  # and to either side
REACH = 0.15  # height in focal lengths up to which the lowest part of an object may show no motion
STEP = 2.0  # pixels between places at which its end is looked for


def just_below(tracks: Tracks, foreground: Bool[np.ndarray, " O"]) -> Int[np.ndarray, "2 E"]:
    """Pairs of foreground observations of one frame, of which the second is just below the first."""
    low, high = BELOW
    middle, box = np.array([0, (low + high) / 2]), np.array([BESIDE, (high - low) / 2])
    pairs = [np.empty((2, 0), int)]
    for group in by_frame(tracks):
        group = group[foreground[group]]
        scaled = tracks.pixels[group] / box
        found = cKDTree(scaled).query_ball_point(scaled + middle / box, 1.0, p=np.inf) if len(group) else []
        upper = np.repeat(group, [len(lower) for lower in found])
        pairs.append(np.stack([upper, group[np.concatenate([*found, []]).astype(int)]]))
    return np.concatenate(pairs, axis=1)


def find_feet(
    tracks: Tracks, foreground: Bool[np.ndarray, " O"], below: Int[np.ndarray, "2 E"], height: int
) -> Bool[np.ndarray, " O"]:
    """Which foreground observations have none of these just `below`, and are not at the lower border of the frame."""
    feet = foreground & (tracks.pixels[:, 1] + BELOW[1] < height)
    feet[below[0]] = False
    return feet


def find_soles(
    frames: Int[np.ndarray, " N"],
    feet: Float[np.ndarray, "N 2"],
    is_background: Callable[[Int[np.ndarray, " M"], Float[np.ndarray, "M 2"]], Bool[np.ndarray, " M"]],
    focal_length: float,
    height: int,
) -> Float[np.ndarray, "N 2"]:
    """Pixels where feet end: somebody's foot that rests on the ground shows no motion, and has no tracks.

    From the lowest part that moves, the object goes on as far down as there is no background; where none is found, it
    is taken to end with that part.

    Args:
        frames: that the feet are seen in.
        feet: their pixels.
        is_background: tells whether frames show the background at pixels.
        focal_length: of the cameras along y, pixels.
        height: of the frames, pixels.
    """
    count = max(int(REACH * focal_length / STEP), 1)
    places = np.repeat(feet[:, None], count, axis=1)
    places[..., 1] += STEP * np.arange(1, count + 1)
    within = places[..., 1] < height
    ends = np.zeros(within.shape, bool)
    ends[within] = is_background(np.repeat(frames, within.sum(-1)), places[within])
    steps = np.where(ends.any(-1), ends.argmax(-1), 0)
    return feet + np.stack([np.zeros(len(feet)), STEP * steps], axis=-1)
