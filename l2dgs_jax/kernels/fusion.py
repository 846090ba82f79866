"""Boundaries that keep XLA's CPU compiler from fusing long arithmetic into one piece."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from l2dgs_jax.kernels.compilation import unfused
from l2dgs_jax.kernels.selection import by_form, chosen_form

T = TypeVar("T")


def unfused_on_cpu(function: Callable[..., T], like: Any = None) -> Callable[..., T]:
    """The same function, not fused with its caller on CPU (see `unfused`). It has no gradient.

    Args:
        function: takes and returns PyTrees of arrays.
        like: shapes and types of its result, if they are known.
    """

    def call(*arguments: Any) -> T:
        shapes = jax.eval_shape(function, *arguments) if like is None else like
        return by_form(*arguments, reference=function, cpu=unfused(function), accelerator=function, like=shapes)

    return call


def fusion_boundary(function: Callable[..., T]) -> Callable[..., T]:
    """The same function of floats; on CPU, neither it nor its gradient is fused with the code around it.

    For long arithmetic with many results: divided by such boundaries, little of it is computed more than once. The
    gradient is recomputed from the arguments, in reverse mode only. Where jax's default backend is not a CPU, or a form
    other than "cpu" is set, the result is the function itself.
    """

    @jax.custom_vjp
    def bounded(*arguments: Any) -> T:
        return unfused_on_cpu(function)(*arguments)

    def backward(arguments: Any, cotangent: Any) -> Any:
        def pull(arguments: Any, cotangent: Any) -> Any:
            return jax.vjp(function, *arguments)[1](cotangent)

        return unfused_on_cpu(pull, like=arguments)(arguments, cotangent)

    bounded.defvjp(lambda *arguments: (bounded(*arguments), arguments), backward)

    def call(*arguments: Any) -> T:
        for_cpu = chosen_form() == "cpu" or (chosen_form() is None and jax.default_backend() == "cpu")
        return (bounded if for_cpu else function)(*arguments)

    return call


def repeat_channels(x: Float[Array, "*S"], channels: int) -> Float[Array, "*S C"]:
    """`x` repeated along a new last axis; carries gradients.

    It is a matrix product because the transpose of a broadcast, a sum over a few channels, is slow on CPU. Precision
    "highest" keeps the values exact on devices whose matrix products round their factors.
    """
    ones = jnp.ones((1, channels), x.dtype)
    return jnp.matmul(x.reshape(-1, 1), ones, precision="highest").reshape(*x.shape, channels)
