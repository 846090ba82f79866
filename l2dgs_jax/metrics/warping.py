"""Temporal stability of a video: its frames compared with the next ones, warped back along the optical flow."""

import cv2
import numpy as np
from jaxtyping import Float

from l2dgs_jax.cameras.flow import pixel_indices


def warping_error_map(
    frame: Float[np.ndarray, "H W C"], following: Float[np.ndarray, "H W C"], flow: Float[np.ndarray, "H W 2"]
) -> Float[np.ndarray, "H W"]:
    """Squared difference of each pixel and its place in the next frame, mean over channels (E_warp, arXiv 1808.00449).

    Args:
        frame: values in [0, 1], NaN where they do not count.
        following: the next frame.
        flow: optical flow from the frame to the next one, pixels; NaN where unknown.

    Returns:
        The errors; NaN where an argument is NaN.
    """
    ends = pixel_indices(*frame.shape[:2]) + flow.astype(np.float32)
    known = np.isfinite(ends).all(-1)
    columns, rows = np.moveaxis(np.where(known[..., None], ends, 0), -1, 0)
    moved = cv2.remap(following, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(known, ((frame - moved) ** 2).mean(-1), np.nan)
