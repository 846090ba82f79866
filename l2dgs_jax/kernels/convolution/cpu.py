"""Convolution between few channels as loops.

XLA's convolution on CPU is made for many channels. For a handful it runs at a fraction of the processor's speed, and
the gradient with respect to its kernel at a fraction of that, on one thread. There, loops that keep the vector units
busy take over. They treat a row of the image as one array of pixels times channels, in which a row of a pixel's window
is contiguous, and handle several rows together: as many as one column of the output needs to have `LANES` values.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped

from l2dgs_jax.kernels.compilation import native_call
from l2dgs_jax.kernels.convolution import reference
from l2dgs_jax.kernels.loops import Index, loop

LANES = 16  # values that a step of the loops computes together: a few vector registers
TERMS = 8  # products that are added to each of them between two memory accesses
LOOP_CHANNELS = 4  # input or output channels up to which a loop is faster than XLA's convolution on several threads

Image = Float[Array, "B H W I"]
Kernel = Float[Array, "K K I O"]


def suits(image: tuple[int, ...], kernel: tuple[int, ...]) -> bool:
    """Whether the loops can handle these shapes."""
    size, _, inputs, outputs = kernel
    # Loops must have more steps than the compiler unrolls.
    return image[0] > 0 and size > 1 and LANES % inputs == LANES % outputs == 0 and min(image[1:3]) > LANES


def convolve(x: Image, kernel: Kernel) -> Float[Array, "B H W O"]:
    """See the contract in `__init__`; only for shapes for which `suits` is true."""
    return (_convolve_by_loops if min(kernel.shape[2:]) <= LOOP_CHANNELS else reference.convolve)(x, kernel)


def gradient(x: Image, kernel: Kernel, cotangent: Float[Array, "B H W O"]) -> tuple[Image, Kernel]:
    """The gradients of `convolve` with respect to both arguments."""
    turned = jnp.flip(kernel, (0, 1)).swapaxes(2, 3)
    return convolve(cotangent, turned), _kernel_gradient_by_loops(x, cotangent, len(kernel))


def _convolve_by_loops(x: Image, kernel: Kernel) -> Float[Array, "B H W O"]:
    batch, height, width, inputs = x.shape
    size, outputs = len(kernel), kernel.shape[-1]
    together, window = LANES // outputs, size * inputs
    blocks = -(-height // together)
    terms = max(n for n in range(1, TERMS + 1) if window % n == 0)
    parts = window // terms
    # For each row of the image that the rows handled together need: its weight for all of them, zero for those that do
    # not need it.
    by_row = kernel.reshape(size, window, outputs)
    shifted = [jnp.pad(by_row, ((row, together - 1 - row), (0, 0), (0, 0))) for row in range(together)]
    weights = jnp.stack(shifted, axis=2).reshape(-1, terms, LANES)

    def convolved(x: Float[Array, "B R P"], weights: Float[Array, "S T L"]) -> Float[Array, "B H W O"]:
        def each_rows(n: Index, out: Float[Array, "B H W O"]) -> Float[Array, "B H W O"]:
            # If the height is not a multiple of `together`, the last rows overlap those before them.
            image, top = n // blocks, jnp.minimum(n % blocks * together, height - together)

            def add_terms(n: Index, sums: Float[Array, "W L"]) -> Float[Array, "W L"]:
                weight = _slice(weights, (n, 0, 0), (1, terms, LANES))[0]
                first = (image, top + n // parts, n % parts * terms)
                run = _slice(x, first, (1, 1, (width - 1) * inputs + terms))[0, 0]
                for term in range(terms):
                    every_pixel = run[term : term + (width - 1) * inputs + 1 : inputs]
                    sums += every_pixel[:, None] * weight[term][None]
                return sums

            sums = loop(len(weights), add_terms, jnp.zeros((width, LANES), x.dtype))
            pixels = sums.reshape(width, together, outputs).swapaxes(0, 1)
            return jax.lax.dynamic_update_slice(out, pixels[None], _start(image, top, 0, 0))

        return loop(batch * blocks, each_rows, jnp.zeros((batch, height, width, outputs), x.dtype))

    return native_call(convolved)(_rows(x, size), weights)


def _kernel_gradient_by_loops(x: Image, cotangent: Float[Array, "B H W O"], size: int) -> Kernel:
    batch, height, width, inputs = x.shape
    outputs = cotangent.shape[-1]
    together, window = LANES // outputs, size * inputs
    blocks, runs = -(-height // together), -(-width // TERMS)
    below, right = blocks * together - height, runs * TERMS - width
    cotangent = jnp.pad(cotangent, ((0, 0), (0, below), (0, right), (0, 0)))
    needed = size + together - 1  # rows of the image

    def correlated(x: Float[Array, "B R P"], cotangent: Float[Array, "B H W O"]) -> tuple[Float[Array, "T L"], ...]:
        def each_rows(n: Index, total: tuple[Float[Array, "T L"], ...]) -> tuple[Float[Array, "T L"], ...]:
            image, top = n // blocks, n % blocks * together

            def each_run(n: Index, sums: tuple[Float[Array, "T L"], ...]) -> tuple[Float[Array, "T L"], ...]:
                left = n * TERMS
                pixels = _slice(cotangent, (image, top, left, 0), (1, together, TERMS, outputs))[0]
                pixels = pixels.swapaxes(0, 1).reshape(TERMS, LANES)

                def with_terms(row: int, in_row: Float[Array, "T L"]) -> Float[Array, "T L"]:
                    run = _slice(x, (image, top + row, left * inputs), (1, 1, (TERMS - 1) * inputs + window))[0, 0]
                    for term in range(TERMS):
                        in_row += run[term * inputs : term * inputs + window][:, None] * pixels[term][None]
                    return in_row

                return tuple(with_terms(row, in_row) for row, in_row in enumerate(sums))

            # A sum of sums: small values added to the total one by one would lose their last digits.
            return jax.tree.map(jnp.add, total, loop(runs, each_run, jax.tree.map(jnp.zeros_like, total)))

        return loop(batch * blocks, each_rows, (jnp.zeros((window, LANES), x.dtype),) * needed)

    total = jnp.stack(native_call(correlated)(_rows(x, size, below, right), cotangent)).reshape(
        needed, size, inputs, together, outputs
    )
    return functools.reduce(jnp.add, (total[row : row + size, :, :, row] for row in range(together)))


def _rows(x: Float[Array, "B H W I"], size: int, below: int = 0, right: int = 0) -> Float[Array, "B R P"]:
    """Rows of pixels times channels, padded for a kernel of `size`, and further below and to the right."""
    reach = size // 2
    padded = jnp.pad(x, ((0, 0), (reach, reach + below), (reach, reach + right), (0, 0)))
    return padded.reshape(*padded.shape[:2], -1)


def _start(*start: Index | int) -> tuple[Index, ...]:
    # Loop counters have 32 bits even where other integers have 64, and all indices of a slice must have the same type.
    return tuple(jnp.asarray(index, jnp.int32) for index in start)


def _slice(array: Shaped[Array, "..."], start: tuple[Index | int, ...], shape: tuple[int, ...]) -> Shaped[Array, "..."]:
    return jax.lax.dynamic_slice(array, _start(*start), shape)
