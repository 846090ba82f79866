"""Low-light dynamic Gaussian splatting in JAX."""
