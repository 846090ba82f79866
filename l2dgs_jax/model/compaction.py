"""Selecting rows of arrays and putting them back: gathers both ways, gradients included, with static shapes."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Subset(NamedTuple):
    """M of N rows.

    Attributes:
        rows: their indices, ascending.
        places: for each of the N rows, its position in `rows`; M for rows outside the subset.
    """

    rows: Int[Array, " M"]
    places: Int[Array, " N"]


def highest(scores: Float[Array, " N"], count: int) -> Subset:
    """The `count` rows that score highest."""
    rows = jnp.sort(jax.lax.top_k(scores, count)[1])
    places = jnp.full(scores.shape, count, rows.dtype).at[rows].set(jnp.arange(count, dtype=rows.dtype))
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
