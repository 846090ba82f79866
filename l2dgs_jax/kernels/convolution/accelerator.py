"""XLA's convolution, which calls the vendor's library."""

from l2dgs_jax.kernels.convolution.reference import convolve, gradient

__all__ = ["convolve", "gradient"]
