"""Frames of a wall before which squares move, for the tests of what is told by colours."""

import numpy as np

from l2dgs_jax.data.color import linear_to_srgb
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.training.backdrop import DEPTH_CELL, Backdrop, Cameras, Depths
from l2dgs_jax.training.tracks import Tracks
from l2dgs_jax.types import Camera

FRAMES, SIDE, DEPTH = 12, 64, 2.0
K = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
COLOUR = np.array([0.03, 0.09, 0.02])
ROWS = {"object": 12, "shadow": 32, "bright": 52}  # of squares that move to the right over a wall


def wall():
    """Light of the wall that cameras at rest see."""
    rng = np.random.default_rng(0)
    return np.repeat(np.repeat(rng.uniform(0.02, 0.1, (8, 8, 3)), 8, 0), 8, 1)


def seen(squares=(COLOUR, 0.6, 1.5)):
    """Frames of the wall with three squares, the first of its own colour, the others changing the light; and tracks."""
    light = np.tile(wall(), (FRAMES, 1, 1, 1))
    numbers, frames, pixels = [], [], []
    for number, (row, square) in enumerate(zip(ROWS.values(), squares, strict=True)):
        for frame in range(FRAMES):
            column = 8 + 4 * frame
            part = light[frame, row - 5 : row + 6, column - 5 : column + 6]
            part[:] = part * square if np.ndim(square) == 0 else square
            numbers.append(number), frames.append(frame), pixels.append((column + 0.5, row + 0.5))
    cameras = Camera(
        np.tile(np.eye(4, dtype=np.float32), (FRAMES, 1, 1)),
        np.tile(K.astype(np.float32), (FRAMES, 1, 1)),
        np.linspace(0, 1, FRAMES, dtype=np.float32),
    )
    split = Split(tuple(map(str, range(FRAMES))), cameras, linear_to_srgb(light).astype(np.float32))
    tracks = Tracks(np.array(numbers), np.array(frames), np.array(pixels), np.ones(len(frames), bool))
    return split, tracks


def backdrop(split, depth=DEPTH):
    """The wall behind everything."""
    cells = np.full((len(split.names), SIDE // DEPTH_CELL, SIDE // DEPTH_CELL), depth, np.float32)
    return Backdrop(Cameras(*(np.asarray(x, float) for x in split.cameras)), Depths(cells[None], cells), None)
