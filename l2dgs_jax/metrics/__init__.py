"""Image quality: similarity of images, whole and by region, and the gain that best corrects brightness."""

from l2dgs_jax.metrics.gain import best_gain
from l2dgs_jax.metrics.images import partial_ssim, psnr, ssim, ssim_map
from l2dgs_jax.metrics.lpips import NETWORKS, Lpips, Network
from l2dgs_jax.metrics.measures import FLIP, MS_SSIM, PSNR, SSIM, SSIM_3DGS, Measure, lpips_measure
from l2dgs_jax.metrics.regions import BASIC, Convention, Score, clipped, compare, known, region_masks, summarise
from l2dgs_jax.metrics.warping import warping_error_map

__all__ = [
    "BASIC",
    "FLIP",
    "MS_SSIM",
    "NETWORKS",
    "PSNR",
    "SSIM",
    "SSIM_3DGS",
    "Convention",
    "Lpips",
    "Measure",
    "Network",
    "Score",
    "best_gain",
    "clipped",
    "compare",
    "known",
    "lpips_measure",
    "partial_ssim",
    "psnr",
    "region_masks",
    "ssim",
    "ssim_map",
    "summarise",
    "warping_error_map",
]
