"""XLA's convolution; differentiated by JAX."""

import jax
from jaxtyping import Array, Float


def convolve(x: Float[Array, "B H W I"], kernel: Float[Array, "K K I O"]) -> Float[Array, "B H W O"]:
    """See the contract in `__init__`."""
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


def gradient(
    x: Float[Array, "B H W I"], kernel: Float[Array, "K K I O"], cotangent: Float[Array, "B H W O"]
) -> tuple[Float[Array, "B H W I"], Float[Array, "K K I O"]]:
    """The gradients of `convolve` with respect to both arguments."""
    return jax.vjp(convolve, x, kernel)[1](cotangent)
