"""PLY files: Gaussians as 3D Gaussian Splatting (arXiv 2308.04079) stores them, and point clouds."""

import numpy as np

from l2dgs_jax.data.clouds import colored_points, encode_ply
from l2dgs_jax.exporters.splats import Splats, sh_coefficients

PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
LEAST = 1e-6  # least scale in world units, and least distance of an opacity from 0 and 1: keeps logarithms finite


def encode(splats: Splats) -> bytes:
    """A PLY file with logarithms of scales, logits of opacities, rotations wxyz and zero normals, single precision."""
    opacities = np.clip(splats.opacities.astype(np.float64), LEAST, 1 - LEAST)
    columns = (
        splats.means,
        np.zeros_like(splats.means),
        sh_coefficients(splats.colors),
        np.log(opacities / (1 - opacities))[:, None],
        np.log(np.maximum(splats.scales, LEAST)),
        splats.quats,
    )
    rows = np.concatenate(columns, axis=-1).astype("<f4")
    return encode_ply(rows.view([(name, "<f4") for name in PROPERTIES])[:, 0])


def encode_cloud(splats: Splats) -> bytes:
    """A PLY file with the centres of the Gaussians as points with 8-bit colours."""
    return encode_ply(colored_points(splats.means, splats.colors.clip(0, 1)))
