"""Image quality: PSNR and SSIM, whole and by region, and what is left of an error after the best gain."""

from l2dgs_jax.metrics.gain import best_gain
from l2dgs_jax.metrics.images import masked_ssim, partial_ssim, psnr, ssim, ssim_map
from l2dgs_jax.metrics.regions import RegionScore, compare, summarise

__all__ = [
    "RegionScore",
    "best_gain",
    "compare",
    "masked_ssim",
    "partial_ssim",
    "psnr",
    "ssim",
    "ssim_map",
    "summarise",
]
