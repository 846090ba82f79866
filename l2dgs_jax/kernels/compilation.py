"""What XLA's CPU compiler compiles together, and what apart."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jaxlib
from jax.experimental.xla_metadata import set_xla_metadata

T = TypeVar("T")

# The attributes below are XLA's own, undocumented, and change between versions. pyproject.toml bounds jax to those that
# the tests of this folder and the benchmarks have seen; when the bound is lifted, run both and add the version here.
VERSION = jaxlib.__version__
TRIED = VERSION.startswith("0.10.")


def native_call(function: Callable[..., T]) -> Callable[..., T]:
    """The same function for a CPU, compiled as one native function that runs on one thread; vmapped, members in turn.

    Otherwise XLA's CPU runtime starts every operation of a loop's body anew and divides it among threads, which takes
    longer than an operation on a few kilobytes itself. `function` may hold loops, gathers, slices and arithmetic, but
    no sort, scatter, matrix product or reduction of a product, and must use every argument, in loops of two steps or
    more: XLA aborts on an argument that its simplifications leave unused.
    """
    call = _call(function, xla_cpu_small_call="true", inlineable="false")
    # Were an argument known to be zero, simplifications might leave another one unused.
    return jax.custom_batching.sequential_vmap(lambda *arguments: call(*jax.lax.optimization_barrier(arguments)))


def unfused(function: Callable[..., T]) -> Callable[..., T]:
    """The same function for a CPU, never fused with what calls it.

    Otherwise XLA computes a value again for each value that is computed from it, where it believes that memory costs
    more. An optimization barrier does not help: it is gone before operations are fused.
    """
    return _call(function, inlineable="false")


def _call(function: Callable[..., T], **attributes: str) -> Callable[..., T]:
    def call(*arguments: Any) -> T:
        leaves, structure = jax.tree.flatten(jax.jit(function)(*arguments))
        return jax.tree.unflatten(structure, set_xla_metadata(leaves, **attributes))

    return call
