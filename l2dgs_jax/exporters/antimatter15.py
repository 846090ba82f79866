"""The .splat format of antimatter15's viewer: 32 bytes a Gaussian."""

import numpy as np

from l2dgs_jax.data.images import to_bytes
from l2dgs_jax.exporters.splats import Splats

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def encode(splats: Splats) -> bytes:
    """Content of a .splat file, with the largest and most opaque Gaussians first, because viewers draw while loading.

    A component q of a rotation (wxyz) is stored as 128 q + 128.
    """
    first = np.argsort(-splats.scales.prod(-1, dtype=np.float64) * splats.opacities, kind="stable")
    splats = Splats(*(rows[first] for rows in splats))
    rows = np.empty(len(first), ROW)
    rows["mean"], rows["scale"] = splats.means, splats.scales
    rows["rgba"] = to_bytes(np.column_stack([splats.colors, splats.opacities]))
    rows["quat"] = np.clip(np.rint(128 * splats.quats + 128), 0, 255)
    return rows.tobytes()
