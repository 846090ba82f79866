"""XLA's convolution, which vendors' libraries carry out."""

from l2dgs_jax.kernels.convolution.reference import convolve, gradient

__all__ = ["convolve", "gradient"]
