"""Counting and radix sorts as loops: XLA's comparison sort is slow on CPU."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.kernels.compilation import native_call, unfused
from l2dgs_jax.kernels.loops import Index, loop, read, write
from l2dgs_jax.kernels.sort.keys import ordered_integers

DIGIT_BITS = 11  # bits that a pass of the radix sort sorts by
BUCKETS = 2**DIGIT_BITS


def argsort(values: Float[Array, " N"]) -> Int[Array, " N"]:
    """See the contract in `__init__`; at least two values."""
    keys = ordered_integers(values)
    integer = keys.dtype.type
    order = jnp.arange(values.shape[0], dtype=jnp.int32)
    for shift in range(0, jnp.iinfo(keys.dtype).bits, DIGIT_BITS):
        digits = ((keys[order] >> integer(shift)) & integer(BUCKETS - 1)).astype(jnp.int32)
        order = order[_counting_sort(digits, BUCKETS)[0]]
    return order


def sort_pairs(
    tiles: Int[Array, " M"], ranks: Int[Array, " M"], *, tile_count: int, rank_count: int
) -> tuple[Int[Array, " M"], Int[Array, " M"], Int[Array, " T1"]]:
    """See the contract in `__init__`."""
    del rank_count  # not needed: the ranks of a tile are in order already, and the sort is stable
    order, starts = _counting_sort(tiles, tile_count + 1)
    return tiles[order], ranks[order], starts[:-1]


def _counting_sort(keys: Int[Array, " M"], buckets: int) -> tuple[Int[Array, " M"], Int[Array, " B1"]]:
    """The stable order of `keys` in 0 ... buckets - 1, and where each bucket starts; the last start is M."""
    return native_call(lambda keys: _count_and_distribute(keys, buckets))(keys)


def _count_and_distribute(keys: Int[Array, " M"], buckets: int) -> tuple[Int[Array, " M"], Int[Array, " B1"]]:
    def count(i: Index, starts: Int[Array, " B1"]) -> Int[Array, " B1"]:
        bucket = read(keys, i) + 1
        return write(starts, bucket, read(starts, bucket) + 1)

    def accumulate(bucket: Index, starts: Int[Array, " B1"]) -> Int[Array, " B1"]:
        return write(starts, bucket, read(starts, bucket) + read(starts, bucket - 1))

    def distribute(
        i: Index, state: tuple[Int[Array, " B"], Int[Array, " M"]]
    ) -> tuple[Int[Array, " B"], Int[Array, " M"]]:
        following, order = state
        bucket = read(keys, i)
        # Not fused: if this read were fused with both writes, XLA would copy the array that it reads from.
        position = unfused(read)(following, bucket)
        return write(following, bucket, position + 1), write(order, position, i)

    starts = loop(keys.shape[0], count, jnp.zeros(buckets + 1, jnp.int32))
    starts = loop(buckets + 1, accumulate, starts, first=1)
    return loop(keys.shape[0], distribute, (starts[:-1], jnp.zeros_like(keys)))[1], starts
