"""Multi-scale SSIM (Wang, Simoncelli and Bovik 2003)."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from l2dgs_jax.metrics.images import C1, C2, NO_VALUE, RADIUS, WINDOW, inside

SCALE_WEIGHTS = np.array([0.0448, 0.2856, 0.3001, 0.2363, 0.1333])

Pixels = Float[np.ndarray, "H W C"]


def ms_ssim_maps(a: Pixels, b: Pixels) -> list[Float[np.ndarray, "_ _ C"]]:
    """For each scale, a map of its terms: contrast times structure, and at the last scale also luminance.

    Every scale has half the rows and columns of the one before. Windows are those of `ssim`. The maps have no value
    where windows extend beyond the image, and nowhere if no window of the last scale fits into it (below 161 pixels).
    """
    if min(a.shape[:2]) <= 2 * RADIUS * 2 ** (len(SCALE_WEIGHTS) - 1):
        return [np.full_like(a, NO_VALUE)] * len(SCALE_WEIGHTS)
    maps = []
    for scale in range(len(SCALE_WEIGHTS)):
        if scale:
            a, b = _halved(a), _halved(b)
        mean_a, mean_b, square, product = map(_window_means, (a, b, a * a + b * b, a * b))
        similarity = (2 * (product - mean_a * mean_b) + C2) / (square - mean_a**2 - mean_b**2 + C2)
        if scale == len(SCALE_WEIGHTS) - 1:
            similarity *= (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
        maps.append(inside(similarity))
    return maps


def pool(means: Sequence[Float[np.ndarray, " C"]]) -> float:
    """MS-SSIM from the means of its maps, averaged over the channels; negative means count as 0."""
    return float(np.prod(np.maximum(means, 0) ** SCALE_WEIGHTS[:, None], axis=0).mean())


def _window_means(image: Pixels) -> Pixels:
    return cv2.sepFilter2D(image, -1, WINDOW, WINDOW).reshape(image.shape)


def _halved(image: Pixels) -> Float[np.ndarray, "h w C"]:
    """Means of two by two pixels; the last row or column of an odd number is repeated."""
    height, width = image.shape[:2]
    even = np.pad(image, [(0, height % 2), (0, width % 2), (0, 0)], "edge")
    return even.reshape(len(even) // 2, 2, even.shape[1] // 2, 2, -1).mean((1, 3))
