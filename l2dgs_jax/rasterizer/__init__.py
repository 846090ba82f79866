"""Rasterization of Gaussians: projection, lists of Gaussians for every tile, blending."""

from l2dgs_jax.rasterizer.rasterization import count_pairs, rasterize

__all__ = ["count_pairs", "rasterize"]
