"""Stable sorts of the rasterizer's keys: by counting on CPU, where XLA's comparison sort is slow."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from l2dgs_jax.native import apart, by_platform, one_function, read, write

DIGIT = 11  # bits that a pass of the radix sort looks at
BUCKETS = 2**DIGIT


def argsort(values: Float[Array, " N"]) -> Int[Array, " N"]:
    """The stable order of floats, NaN with its sign bit clear last; carries no gradients."""
    by_comparing = lambda values: jnp.argsort(values).astype(jnp.int32)
    if values.shape[0] < 2:
        return by_comparing(values)
    return by_platform(values, cpu=_radix_argsort, default=by_comparing)


def group(
    tiles: Int[Array, " M"], ranks: Int[Array, " M"], tile_count: int, rank_count: int
) -> tuple[Int[Array, " M"], Int[Array, " M"], Int[Array, " T1"]]:
    """Pairs sorted by tile, then rank, and where each tile starts; carries no gradients.

    Args:
        tiles: 0 ... `tile_count`; that last number collects the dropped pairs.
        ranks: less than `rank_count`; those of a tile come in ascending order.
        tile_count: how many tiles there are.
        rank_count: how many ranks there are.
    """
    by_counting = lambda tiles, ranks: _by_counting(tiles, ranks, tile_count)
    by_comparing = lambda tiles, ranks: _by_comparing(tiles, ranks, tile_count, rank_count)
    return by_platform(tiles, ranks, cpu=by_counting, default=by_comparing)


def _by_comparing(tiles, ranks, tile_count, rank_count):
    bits = rank_count.bit_length()
    borders = jnp.arange(tile_count + 1, dtype=jnp.uint32)
    if bits + tile_count.bit_length() > 32:
        tiles, ranks = jax.lax.sort((tiles, ranks), num_keys=2)
        return tiles, ranks, jnp.searchsorted(tiles, borders.astype(tiles.dtype)).astype(jnp.int32)
    # One key of 32 bits sorts several times faster than a key with a payload.
    keys = jnp.sort((tiles.astype(jnp.uint32) << bits) | ranks.astype(jnp.uint32))
    tiles, ranks = (keys >> bits).astype(jnp.int32), (keys & (2**bits - 1)).astype(jnp.int32)
    return tiles, ranks, jnp.searchsorted(keys, borders << bits).astype(jnp.int32)


def _by_counting(tiles, ranks, tile_count):
    order, starts = _counting_sort(tiles, tile_count + 1)
    return tiles[order], ranks[order], starts[:-1]


def _counting_sort(keys: Int[Array, " M"], buckets: int) -> tuple[Int[Array, " M"], Int[Array, " B1"]]:
    """The stable order of `keys` in 0 ... buckets - 1, and where each bucket starts; the last start is M."""
    in_turn = one_function(lambda keys: _count_and_place(keys, buckets))
    return jax.custom_batching.sequential_vmap(in_turn)(keys)


def _count_and_place(keys, buckets):
    def count(i, starts):
        bucket = read(keys, i) + 1
        return write(starts, bucket, read(starts, bucket) + 1)

    def accumulate(bucket, starts):
        return write(starts, bucket, read(starts, bucket) + read(starts, bucket - 1))

    def place(i, state):
        following, order = state
        bucket = read(keys, i)
        # Read apart: merged into both writes, it would make XLA copy the array that it reads from.
        position = apart(read)(following, bucket)
        return write(following, bucket, position + 1), write(order, position, i)

    loop = lambda low, high, body, state: jax.lax.fori_loop(jnp.int32(low), jnp.int32(high), body, state)
    starts = loop(0, keys.shape[0], count, jnp.zeros(buckets + 1, jnp.int32))
    starts = loop(1, buckets + 1, accumulate, starts)
    return loop(0, keys.shape[0], place, (starts[:-1], jnp.zeros_like(keys)))[1], starts


def _radix_argsort(values):
    integer = {4: jnp.uint32, 8: jnp.uint64}[values.dtype.itemsize]
    size = jnp.iinfo(integer).bits
    bits = jax.lax.bitcast_convert_type(values, integer)
    # Integers in the order of the floats: of a negative one all bits are flipped, of the others the sign.
    keys = jnp.where(bits >> integer(size - 1) == 1, ~bits, bits | integer(1 << (size - 1)))
    order = jnp.arange(values.shape[0], dtype=jnp.int32)
    for shift in range(0, size, DIGIT):
        digits = ((keys[order] >> integer(shift)) & integer(BUCKETS - 1)).astype(jnp.int32)
        order = order[_counting_sort(digits, BUCKETS)[0]]
    return order
