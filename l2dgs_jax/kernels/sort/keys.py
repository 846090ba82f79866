"""Integers that sort as floats do."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt


def ordered_integers(values: Float[Array, " N"]) -> UInt[Array, " N"]:
    """Unsigned integers in the order of the floats: all bits flipped for negative floats, else only the sign bit."""
    integer = {4: jnp.uint32, 8: jnp.uint64}[values.dtype.itemsize]
    sign = jnp.iinfo(integer).bits - 1
    bits = jax.lax.bitcast_convert_type(values, integer)
    return jnp.where(bits >> integer(sign) == 1, ~bits, bits | integer(1 << sign))
