"""Selecting rows of arrays and putting them back: gathers both ways, gradients included, with static shapes."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.kernels.loops import loop

Shared = TypeVar("Shared")
Rows = TypeVar("Rows")
Results = TypeVar("Results")

CHUNKS = 16  # into which `map_chosen` divides the rows: those after the last chosen one cost nothing


class Subset(NamedTuple):
    """Some of N rows.

    Attributes:
        rows: their indices, ascending, in an array of length M; N where there are no more.
        places: for each of the N rows, its position in `rows`; M for rows outside the subset.
    """

    rows: Int[Array, " M"]
    places: Int[Array, " N"]


def highest(scores: Float[Array, " N"], count: int) -> Subset:
    """The `count` rows that score highest."""
    return subset_of(jnp.zeros(len(scores), bool).at[jax.lax.top_k(scores, count)[1]].set(True), count)


def subset_of(chosen: Bool[Array, " N"], size: int) -> Subset:
    """The rows that are chosen, up to `size` of them."""
    places = jnp.where(chosen, jnp.cumsum(chosen) - 1, size).astype(jnp.int32)
    count = len(chosen)
    rows = jnp.full(size, count, jnp.int32).at[places].set(jnp.arange(count, dtype=jnp.int32), mode="drop")
    return Subset(rows, places)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def select(values: Float[Array, "..."], subset: Subset, axis: int) -> Float[Array, "..."]:
    """The rows of the subset, out of N along an axis; `values` carry gradients."""
    return jnp.take(values, subset.rows, axis, mode="clip")


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def expand(values: Float[Array, "..."], subset: Subset, axis: int) -> Float[Array, "..."]:
    """N rows along an axis: the M of the subset, which are given, and 0 elsewhere; `values` carry gradients."""
    return jnp.take(values, subset.places, axis, mode="fill", fill_value=0)


# Each is the other's transpose. JAX would transpose the gathers into scatters, which are many times slower on a CPU.
def _selected(values: Float[Array, "..."], subset: Subset, axis: int) -> tuple[Float[Array, "..."], Subset]:
    return select(values, subset, axis), subset


def _expanded(values: Float[Array, "..."], subset: Subset, axis: int) -> tuple[Float[Array, "..."], Subset]:
    return expand(values, subset, axis), subset


select.defvjp(_selected, lambda axis, subset, gradient: (expand(gradient, subset, axis), None))
expand.defvjp(_expanded, lambda axis, subset, gradient: (select(gradient, subset, axis), None))


def map_chosen(
    function: Callable[[Shared, Rows], Results], shared: Shared, rows: Rows, chosen: Bool[Array, " N"]
) -> Results:
    """`function(shared, rows)` for the chosen rows, and 0 for all others, which take no time.

    The chosen rows are moved to the front and computed chunk by chunk, as many as there are: nothing is recompiled
    when their number changes. The backward pass computes each chunk again, so memory does not hold what lies between
    the rows and the results of all chunks. Gradients flow to `shared` and `rows`, in reverse mode only.

    Args:
        function: computes each row by itself. Its results have the axis of the rows second.
        shared: arrays that all rows share.
        rows: arrays of N rows, of floats.
        chosen: which rows are computed.
    """
    count = len(chosen)
    length = max(-(-count // CHUNKS), 1)
    subset = subset_of(chosen, length * -(-count // length))
    return _map_front(function, length, shared, rows, subset, chosen.sum().astype(jnp.int32))


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _map_front(
    function: Callable[[Shared, Rows], Results],
    length: int,
    shared: Shared,
    rows: Rows,
    subset: Subset,
    count: Int[Array, ""],
) -> Results:
    """`map_chosen` for the first `count` rows of the subset, `length` at a time."""

    def step(i: Int[Array, ""], found: Results) -> Results:
        put = partial(jax.lax.dynamic_update_slice_in_dim, start_index=i * length, axis=1)
        return jax.tree.map(put, found, function(shared, _chunk_of(rows, subset, i, length, 0)))

    like = jax.eval_shape(function, shared, jax.eval_shape(lambda: _chunk_of(rows, subset, 0, length, 0)))
    empty = lambda x: jnp.zeros((x.shape[0], len(subset.rows), *x.shape[2:]), x.dtype)
    found = loop(_chunks(count, length), step, jax.tree.map(empty, like))
    return jax.tree.map(lambda x: expand(x, subset, 1), found)


def _mapped(
    function: Callable[..., Results],
    length: int,
    shared: Any,
    rows: Any,
    subset: Subset,
    count: Int[Array, ""],
) -> tuple[Results, tuple]:
    return _map_front(function, length, shared, rows, subset, count), (shared, rows, subset, count)


def _map_gradient(function: Callable[..., Any], length: int, inputs: tuple, gradient: Any) -> tuple:
    shared, rows, subset, count = inputs

    def step(i: Int[Array, ""], so_far: tuple) -> tuple:
        _, pull = jax.vjp(function, shared, _chunk_of(rows, subset, i, length, 0))
        of_shared, of_rows = pull(_chunk_of(gradient, subset, i, length, 1))
        put = partial(jax.lax.dynamic_update_slice_in_dim, start_index=i * length, axis=0)
        return jax.tree.map(jnp.add, so_far[0], of_shared), jax.tree.map(put, so_far[1], of_rows)

    empty = lambda x: jnp.zeros((len(subset.rows), *x.shape[1:]), x.dtype)
    start = jax.tree.map(jnp.zeros_like, shared), jax.tree.map(empty, rows)
    of_shared, of_rows = loop(_chunks(count, length), step, start)
    return of_shared, jax.tree.map(lambda x: expand(x, subset, 0), of_rows), None, None


_map_front.defvjp(_mapped, _map_gradient)


def _chunk_of(tree: Rows, subset: Subset, i: Int[Array, ""] | int, length: int, axis: int) -> Rows:
    """Chunk i of the rows of the subset, along an axis; 0 where there are no more."""
    own = jax.lax.dynamic_slice_in_dim(subset.rows, i * length, length)
    return jax.tree.map(lambda x: jnp.take(x, own, axis, mode="fill", fill_value=0), tree)


def _chunks(count: Int[Array, ""], length: int) -> Int[Array, ""]:
    return (count + length - 1) // length
