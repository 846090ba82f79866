"""Points in front of cameras that look along z."""

import numpy as np

from l2dgs_jax.types import Camera

POINTS = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 4], (20, 3)).astype(np.float32)


def cameras(centres):
    viewmat = np.tile(np.eye(4), (len(centres), 1, 1))
    viewmat[:, :3, 3] = -np.asarray(centres)
    K = np.tile(np.array([[10.0, 0, 8], [0, 10, 6], [0, 0, 1]]), (len(centres), 1, 1))
    return Camera(viewmat, K, np.linspace(0, 1, len(centres)))
