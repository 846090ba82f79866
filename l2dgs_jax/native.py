"""What XLA's CPU compiler compiles together, and what apart."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import jaxlib
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Float, Int, Shaped

T = TypeVar("T")

# The attributes below are XLA's own: only the compilers that were tried with them are given them.
TRIED = jaxlib.__version__.startswith("0.10.")


def one_function(function: Callable[..., T]) -> Callable[..., T]:
    """The same function, compiled for CPU as a whole; it then runs on one thread.

    Otherwise XLA's CPU runtime starts every operation of a loop's body anew and divides it among threads, which takes
    longer than an operation on a few kilobytes itself. `function` may hold loops, gathers, slices and arithmetic, but
    no sort, scatter, matrix product or reduction of a product, and must use every argument, in loops of two steps or
    more: XLA aborts on an argument that its simplifications leave unused.
    """
    if not TRIED:
        return function

    call = _call(function, xla_cpu_small_call="true", inlineable="false")
    # Were an argument known to be zero, simplifications might leave another one unused.
    return lambda *arguments: call(*jax.lax.optimization_barrier(arguments))


def by_platform(*arguments: Any, cpu: Callable[..., T], default: Callable[..., T]) -> T:
    """`jax.lax.platform_dependent`, but where there is nothing but a CPU the other form is not even traced."""
    if jax.default_backend() == "cpu":
        return cpu(*arguments)
    return jax.lax.platform_dependent(*arguments, cpu=cpu, default=default)


def apart(function: Callable[..., T]) -> Callable[..., T]:
    """The same function, on CPU never merged with what calls it.

    Otherwise XLA computes a value again for each value that is computed from it, where it believes that memory costs
    more. An optimization barrier does not help: it is gone before operations are merged.
    """
    if not TRIED:
        return function
    separate = _call(function, inlineable="false")
    return lambda *arguments: by_platform(*arguments, cpu=separate, default=function)


def stage(function: Callable[..., T]) -> Callable[..., T]:
    """The same function, kept `apart`, and so is its gradient, which is computed from the arguments; reverse mode only.

    For long arithmetic with many results: divided into stages, little of it is computed more than once.
    """
    staged = jax.custom_vjp(lambda *arguments: apart(function)(*arguments))

    def backward(arguments, cotangent):
        pull = lambda arguments, cotangent: jax.vjp(function, *arguments)[1](cotangent)
        return apart(pull)(arguments, cotangent)

    staged.defvjp(lambda *arguments: (staged(*arguments), arguments), backward)
    return staged


def read(array: Shaped[Array, " N"], i: Int[Array, ""]) -> Shaped[Array, ""]:
    """`array[i]` with `i` clamped to the array."""
    return jax.lax.dynamic_index_in_dim(array, i, keepdims=False)


def write(array: Shaped[Array, " N"], i: Int[Array, ""], value: Shaped[Array, ""]) -> Shaped[Array, " N"]:
    """`array.at[i].set(value)` with `i` clamped to the array, in the form that loops do in place."""
    return jax.lax.dynamic_update_slice(array, value[None], (i,))


def read_row(table: Float[Array, "N D"], i: Int[Array, ""]) -> Float[Array, "1 D"]:
    """`table[i : i + 1]` with `i` clamped to the table."""
    return jax.lax.dynamic_slice(table, (i, jnp.int32(0)), (1, table.shape[1]))


def write_row(table: Float[Array, "N D"], i: Int[Array, ""], row: Float[Array, "1 D"]) -> Float[Array, "N D"]:
    """`table.at[i].set(row[0])` with `i` clamped to the table, in the form that loops do in place."""
    return jax.lax.dynamic_update_slice(table, row, (i, jnp.int32(0)))


def add_row(table: Float[Array, "N D"], i: Int[Array, ""], row: Float[Array, "1 D"]) -> Float[Array, "N D"]:
    """`table.at[i].add(row[0])` in the form that loops do in place."""
    return write_row(table, i, read_row(table, i) + row)


def add_rows_in_turn(
    table: Float[Array, "N D"], ids: Int[Array, "*S"], rows: Float[Array, "*S D"]
) -> Float[Array, "N D"]:
    """`table.at[ids].add(rows)` as a loop, which `one_function` can hold."""
    ids, rows = ids.reshape(-1), rows.reshape(-1, table.shape[1])
    add = lambda i, table: add_row(table, read(ids, i), read_row(rows, i))
    return jax.lax.fori_loop(jnp.int32(0), jnp.int32(ids.shape[0]), add, table)


def widen(x: Float[Array, "*S"], channels: int) -> Float[Array, "*S C"]:
    """`x` repeated along a new last axis; carries gradients.

    A matrix product, not a broadcast, because of its transpose: a sum over a few channels is slow on CPU. "highest"
    keeps the values exact where products round their factors.
    """
    ones = jnp.ones((1, channels), x.dtype)
    return jnp.matmul(x.reshape(-1, 1), ones, precision="highest").reshape(*x.shape, channels)


def _call(function: Callable[..., T], **attributes: str) -> Callable[..., T]:
    def call(*arguments):
        leaves, structure = jax.tree.flatten(jax.jit(function)(*arguments))
        return jax.tree.unflatten(structure, set_xla_metadata(leaves, **attributes))

    return call
