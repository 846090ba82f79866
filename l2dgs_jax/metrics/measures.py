"""Measures of image quality, split into local maps and a score, so that any region of an image can be scored."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float

from l2dgs_jax.metrics import lpips
from l2dgs_jax.metrics.flip import flip_map
from l2dgs_jax.metrics.images import NO_VALUE, RADIUS, Border, inside, partial_ssim, ssim_map, valid_ssim_map
from l2dgs_jax.metrics.multiscale import ms_ssim_maps, pool

Pixels = Float[np.ndarray, "H W C"]
Mask = Bool[np.ndarray, "H W"]
Maps = Sequence[Float[np.ndarray, "_ _ _"]]


class Measure(NamedTuple):
    """A score made of means of local values.

    Attributes:
        maps: local values, or `NO_VALUE`, for a prediction and the ground truth, at one or more resolutions.
        score: the score, given the mean of each map, one number per channel.
        masked: the score of a mask's pixels alone; None if it is that of `maps` of images with all else set to black.
        partial: `maps` from valid pixels alone; None if it is that of images that are equal at all others.
        spread: whether by the convention "paper" a region's score is the whole frame's times its share of the area.
    """

    maps: Callable[[Pixels, Pixels], Maps]
    score: Callable[[Sequence[Float[np.ndarray, " _"]]], float]
    masked: Callable[[Pixels, Pixels, Mask], float] | None = None
    partial: Callable[[Pixels, Pixels, Mask], Maps] | None = None
    spread: bool = False


def mean_score(maps: Maps, measure: Measure, mask: Mask) -> float:
    """The score of the pixels in `mask`, resized to each map by nearest pixels; NaN if a map has no value there."""
    return measure.score([_mean(values, _nearest(mask, values.shape[:2])) for values in maps])


def lpips_measure(network: lpips.Network, weights: lpips.Lpips | None) -> Measure:
    """LPIPS with a network (arXiv 1801.03924); NaN without its weights.

    Its `masked` form is the mean over the mask of maps enlarged to the image, as DyCheck's mLPIPS (arXiv 2210.13445).
    """

    def maps(a: Pixels, b: Pixels) -> Maps:
        if weights is None or min(a.shape[:2]) < lpips.SMALLEST_SIDE[network]:
            return [np.full((1, 1, 1), NO_VALUE)]
        return [np.asarray(x)[..., None] for x in _lpips_maps(network, weights, a, b)]

    def masked(a: Pixels, b: Pixels, mask: Mask) -> float:
        seen, (height, width) = mask[..., None], mask.shape
        enlarged = [cv2.resize(x, (width, height), interpolation=cv2.INTER_LINEAR) for x in maps(a * seen, b * seen)]
        return _total([_mean(x[..., None], mask) for x in enlarged])

    return Measure(maps, _total, masked, spread=True)


def _ssim(border: Border) -> Callable[[Pixels, Pixels], Maps]:
    compiled = jax.jit(lambda a, b: ssim_map(a, b, border))

    def maps(a: Pixels, b: Pixels) -> Maps:
        similarity = np.asarray(compiled(a, b))
        return [similarity if border == "zero" else _windows(similarity)]

    return maps


def _windows(similarity: Float[np.ndarray, "H W C"]) -> Float[np.ndarray, "H W C"]:
    """A map with values only where the window lies inside the image, unless the image is too small for one."""
    return similarity if min(similarity.shape[:2]) <= 2 * RADIUS else inside(similarity)


def _mean(values: Float[np.ndarray, "H W C"], mask: Mask) -> Float[np.ndarray, " C"]:
    counted = values[mask & (values[..., 0] != NO_VALUE)]
    return counted.mean(0, np.float64) if len(counted) else np.full(values.shape[2], np.nan)


def _nearest(mask: Mask, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    if mask.shape == shape:
        return mask
    return cv2.resize(mask.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST).astype(bool)


def _decibel(means: Sequence[Float[np.ndarray, " _"]]) -> float:
    with np.errstate(divide="ignore"):
        return float(-10 * np.log10(means[0].mean()))


def _total(means: Sequence[Float[np.ndarray, " _"]]) -> float:
    return float(np.sum([mean.mean() for mean in means]))


_partial_ssim, _valid_ssim_map = jax.jit(partial_ssim), jax.jit(valid_ssim_map)
_lpips_maps = jax.jit(lpips.lpips_maps, static_argnums=0)

PSNR = Measure(lambda a, b: [(a - b) ** 2], _decibel)
SSIM = Measure(
    _ssim("mirror"),
    _total,
    masked=lambda a, b, mask: float(_partial_ssim(a, b, mask)),
    partial=lambda a, b, valid: [_windows(np.asarray(_valid_ssim_map(a, b, valid)))],
)
SSIM_3DGS = Measure(_ssim("zero"), _total)
MS_SSIM = Measure(ms_ssim_maps, pool)
FLIP = Measure(lambda a, b: [flip_map(a, b)[..., None]], _total)
