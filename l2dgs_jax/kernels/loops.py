"""Reading and writing array elements inside loops, by operations that XLA performs in place."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Shaped

T = TypeVar("T")
Index = Int[Array, ""]


def loop(steps: int | Index, body: Callable[[Index, T], T], state: T, first: int | Index = 0) -> T:
    """`body(i, state)` for i from `first` to `steps` - 1; counters have 32 bits even where other integers have 64."""
    return jax.lax.fori_loop(jnp.int32(first), jnp.int32(steps), body, state)


def read(array: Shaped[Array, " N"], i: Index) -> Shaped[Array, ""]:
    """`array[i]` with `i` clamped to the array."""
    return jax.lax.dynamic_index_in_dim(array, i, keepdims=False)


def write(array: Shaped[Array, " N"], i: Index, value: Shaped[Array, ""]) -> Shaped[Array, " N"]:
    """`array.at[i].set(value)` with `i` clamped to the array."""
    return jax.lax.dynamic_update_slice(array, value[None], (i,))


def read_row(table: Float[Array, "N D"], i: Index) -> Float[Array, "1 D"]:
    """`table[i : i + 1]` with `i` clamped to the table."""
    return jax.lax.dynamic_slice(table, (i, jnp.int32(0)), (1, table.shape[1]))


def write_row(table: Float[Array, "N D"], i: Index, row: Float[Array, "1 D"]) -> Float[Array, "N D"]:
    """`table.at[i].set(row[0])` with `i` clamped to the table."""
    return jax.lax.dynamic_update_slice(table, row, (i, jnp.int32(0)))


def add_row(table: Float[Array, "N D"], i: Index, row: Float[Array, "1 D"]) -> Float[Array, "N D"]:
    """`table.at[i].add(row[0])` with `i` clamped to the table."""
    return write_row(table, i, read_row(table, i) + row)


def add_rows(table: Float[Array, "N D"], ids: Int[Array, "*S"], rows: Float[Array, "*S D"]) -> Float[Array, "N D"]:
    """`table.at[ids].add(rows)`, one row after the other."""
    ids, rows = ids.reshape(-1), rows.reshape(-1, table.shape[1])
    return loop(ids.shape[0], lambda i, table: add_row(table, read(ids, i), read_row(rows, i)), table)
