"""How the regions of a frame compare with the truth."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from l2dgs_jax.metrics.images import Image, Mask, masked_ssim, partial_ssim, psnr, ssim


class RegionScore(NamedTuple):
    """How one region of one frame compares with the truth.

    Attributes:
        psnr: dB.
        ssim: mean of the SSIM map (of the windows inside the image for the whole frame).
    """

    psnr: float
    ssim: float


def compare(
    prediction: Image,
    truth: Image,
    dynamic: Mask | None = None,
    valid: Mask | None = None,
    covisible: Mask | None = None,
) -> dict[str, RegionScore]:
    """Score one frame, values in [0, 1].

    Args:
        prediction: rendered image.
        truth: what it should be.
        dynamic: which pixels show something that moves.
        valid: which pixels count; None for all. "overall" is then scored as "covisible" is.
        covisible: which pixels enough training views have seen.

    Returns:
        The score of "overall", given `dynamic` of "dynamic" and "static", and given `covisible` of "covisible" as
        DyCheck does (mPSNR, mSSIM), those of them that have any pixel.
    """
    prediction, truth = np.asarray(prediction), np.asarray(truth, prediction.dtype)
    counted = np.ones(prediction.shape[:2], bool) if valid is None else np.asarray(valid)
    truth = np.where(counted[..., None], truth, prediction)
    masks = {"overall": counted}
    if dynamic is not None:
        masks |= {"dynamic": counted & np.asarray(dynamic), "static": counted & ~np.asarray(dynamic)}
    if covisible is not None:
        masks["covisible"] = counted & np.asarray(covisible)
    scores = {}
    for region, mask in masks.items():
        if not mask.any():
            continue
        if region == "overall" and valid is None:
            similarity = _ssim(prediction, truth)
        else:
            measure = _masked_ssim if region in ("dynamic", "static") else _partial_ssim
            similarity = measure(prediction, truth, mask)
        scores[region] = RegionScore(float(_psnr(prediction, truth, mask)), float(similarity))
    return scores


def summarise(frames: Sequence[dict[str, RegionScore]]) -> dict[str, dict[str, float]]:
    """Means of "psnr" (dB) and "ssim" per region, each over the frames that `compare` scored the region in."""
    regions = dict.fromkeys(region for frame in frames for region in frame)
    return {
        region: {
            key: float(np.mean([getattr(frame[region], key) for frame in frames if region in frame]))
            for key in ("psnr", "ssim")
        }
        for region in regions
    }


_ssim, _masked_ssim, _partial_ssim, _psnr = jax.jit(ssim), jax.jit(masked_ssim), jax.jit(partial_ssim), jax.jit(psnr)
