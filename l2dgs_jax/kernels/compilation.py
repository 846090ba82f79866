"""Control over what XLA's CPU compiler compiles together, and what separately."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jaxlib
from jax.experimental.xla_metadata import set_xla_metadata

T = TypeVar("T")

# The attributes below are undocumented internals of XLA and change between versions. pyproject.toml limits jax to
# versions with which the tests of this folder and the benchmarks were run; before that limit is raised, run both with
# the new version and add it here.
VERSION = jaxlib.__version__
TESTED = VERSION.startswith("0.10.")


def native_call(function: Callable[..., T]) -> Callable[..., T]:
    """The same function for a CPU, compiled as one native function on one thread; under vmap, members run in turn.

    Otherwise XLA's CPU runtime dispatches every operation of a loop's body separately and divides it among threads,
    which takes longer than an operation on a few kilobytes itself. `function` may contain loops, gathers, slices and
    arithmetic, but no sort, scatter, matrix product or reduction of a product. It must use every argument, and its
    loops must have at least two steps: XLA aborts if its simplifications leave an argument unused.
    """
    call = _call(function, xla_cpu_small_call="true", inlineable="false")
    # The barrier hides constants: if an argument were known to be zero, simplifications might leave another one unused.
    return jax.custom_batching.sequential_vmap(lambda *arguments: call(*jax.lax.optimization_barrier(arguments)))


def unfused(function: Callable[..., T]) -> Callable[..., T]:
    """The same function for a CPU, never fused with its caller.

    Otherwise XLA recomputes a value for each value that depends on it, where it estimates that to be cheaper than
    memory access. An optimization barrier does not help: it is removed before operations are fused.
    """
    return _call(function, inlineable="false")


def _call(function: Callable[..., T], **attributes: str) -> Callable[..., T]:
    def call(*arguments: Any) -> T:
        leaves, structure = jax.tree.flatten(jax.jit(function)(*arguments))
        return jax.tree.unflatten(structure, set_xla_metadata(leaves, **attributes))

    return call
