"""Long arithmetic divided into parts that a CPU's compiler keeps apart."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from l2dgs_jax.kernels.compilation import unfused
from l2dgs_jax.kernels.selection import by_form, chosen_form

T = TypeVar("T")


def unfused_on_cpu(function: Callable[..., T], like: Any = None) -> Callable[..., T]:
    """The same function, on CPU not fused with what calls it (see `unfused`). Without gradients of its own.

    Args:
        function: of PyTrees of arrays.
        like: shapes and types of its result, if they are known.
    """

    def call(*arguments: Any) -> T:
        shapes = jax.eval_shape(function, *arguments) if like is None else like
        return by_form(*arguments, reference=function, cpu=unfused(function), accelerator=function, like=shapes)

    return call


def fusion_boundary(function: Callable[..., T]) -> Callable[..., T]:
    """The same function of floats; on CPU it is kept apart, and so is its gradient, computed from the arguments.

    For long arithmetic with many results: divided by such boundaries, little of it is computed more than once. With a
    boundary, gradients are reverse mode only. Where jax's default backend is no CPU, or a form other than "cpu" is set,
    it is the function itself.
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

    A matrix product, not a broadcast, because of its transpose: a sum over a few channels is slow on CPU. "highest"
    keeps the values exact where products round their factors.
    """
    ones = jnp.ones((1, channels), x.dtype)
    return jnp.matmul(x.reshape(-1, 1), ones, precision="highest").reshape(*x.shape, channels)
