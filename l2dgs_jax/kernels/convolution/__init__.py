"""Convolution between few channels, and its gradients."""

import jax
from jaxtyping import Array, Float

from l2dgs_jax.kernels.convolution import accelerator, cpu, reference
from l2dgs_jax.kernels.selection import by_form, functions_by_form

Image = Float[Array, "B H W I"]
Kernel = Float[Array, "K K I O"]


def convolve(x: Image, kernel: Kernel) -> Float[Array, "B H W O"]:
    """Convolution with zero padding that keeps the size. Gradients flow to both arguments.

    For large images with 1, 2, 4, 8 or 16 input and output channels they are in reverse mode only.

    Args:
        x: images.
        kernel: weights, of odd size.
    """
    return _with_few_channels(x, kernel) if cpu.suits(x.shape, kernel.shape) else reference.convolve(x, kernel)


@jax.custom_vjp
def _with_few_channels(x: Image, kernel: Kernel) -> Float[Array, "B H W O"]:
    like = jax.ShapeDtypeStruct((*x.shape[:3], kernel.shape[3]), x.dtype)
    forms = functions_by_form("convolve", reference=reference, cpu=cpu, accelerator=accelerator)
    return by_form(x, kernel, **forms, like=like)


def _forward(x: Image, kernel: Kernel) -> tuple[Float[Array, "B H W O"], tuple[Image, Kernel]]:
    return _with_few_channels(x, kernel), (x, kernel)


def _backward(inputs: tuple[Image, Kernel], cotangent: Float[Array, "B H W O"]) -> tuple[Image, Kernel]:
    forms = functions_by_form("gradient", reference=reference, cpu=cpu, accelerator=accelerator)
    return by_form(*inputs, cotangent, **forms, like=inputs)


_with_few_channels.defvjp(_forward, _backward)
