"""Image quality: PSNR and SSIM, whole and by region."""

from l2dgs_jax.metrics.images import masked_ssim, partial_ssim, psnr, ssim, ssim_map
from l2dgs_jax.metrics.regions import RegionScore, compare, gain, summarise

__all__ = ["RegionScore", "compare", "gain", "masked_ssim", "partial_ssim", "psnr", "ssim", "ssim_map", "summarise"]
