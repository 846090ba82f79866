"""Convolution between few channels, and its gradients.

XLA's convolution on CPU is made for many channels. For a handful it runs at a fraction of the processor's speed, and
the gradient in its kernel at a fraction of that, on one thread; loops that keep the vector units busy take over there.
They see an image as rows of pixels times channels, in which a row of a pixel's window is one run of values, and handle
as many rows of pixels together as it takes for `LANES` values of one column of the output to lie side by side.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from l2dgs_jax.native import by_platform, one_function

LANES = 16  # values that a step of the loops computes side by side: a few vector registers
TERMS = 8  # products added to each of them between two visits to memory
FEW = 4  # channels on either side, up to which a loop outruns XLA's convolution even where that has several threads


def convolve(x: Float[Array, "B H W I"], kernel: Float[Array, "K K I O"]) -> Float[Array, "B H W O"]:
    """Convolution with zero padding that keeps the size. Gradients flow to both arguments.

    Those of large images between 1, 2, 4, 8 or 16 channels in reverse mode only, and on CPU by loops.

    Args:
        x: images.
        kernel: weights, of odd size.
    """
    size, _, inputs, outputs = kernel.shape
    fitting = size > 1 and LANES % inputs == LANES % outputs == 0
    # Loops must have more steps than the compiler unrolls.
    large = min(x.shape[1:3]) > LANES
    return _few(x, kernel) if fitting and large else _many(x, kernel)


def _many(x, kernel):
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


@jax.custom_vjp
def _few(x, kernel):
    return by_platform(x, kernel, cpu=_on_cpu, default=_many)


def _forward(x, kernel):
    return _few(x, kernel), (x, kernel)


def _backward(inputs, cotangent):
    pull = lambda x, kernel, cotangent: jax.vjp(_many, x, kernel)[1](cotangent)
    return by_platform(*inputs, cotangent, cpu=_pull_on_cpu, default=pull)


_few.defvjp(_forward, _backward)


def _on_cpu(x, kernel):
    return (_in_turn if min(kernel.shape[2:]) <= FEW else _many)(x, kernel)


def _pull_on_cpu(x, kernel, cotangent):
    turned = jnp.flip(kernel, (0, 1)).swapaxes(2, 3)
    return _on_cpu(cotangent, turned), _pull_kernel_in_turn(x, cotangent, len(kernel))


def _in_turn(x, kernel):
    batch, height, width, inputs = x.shape
    size, outputs = len(kernel), kernel.shape[-1]
    together, window = LANES // outputs, size * inputs
    blocks = -(-height // together)
    terms = max(n for n in range(1, TERMS + 1) if window % n == 0)
    parts = window // terms
    # For each row of the image that rows of pixels need together, the weights of all of them, zero where one does not.
    by_row = kernel.reshape(size, window, outputs)
    shifted = [jnp.pad(by_row, ((row, together - 1 - row), (0, 0), (0, 0))) for row in range(together)]
    weights = jnp.stack(shifted, axis=2).reshape(-1, terms, LANES)

    def convolved(x, weights):
        def each_rows(n, out):
            # The last rows of pixels overlap those before them if they do not come out even.
            image, top = n // blocks, jnp.minimum(n % blocks * together, height - together)

            def add_terms(n, sums):
                weight = _part(weights, (n, 0, 0), (1, terms, LANES))[0]
                first = (image, top + n // parts, n % parts * terms)
                run = _part(x, first, (1, 1, (width - 1) * inputs + terms))[0, 0]
                for term in range(terms):
                    every_pixel = run[term : term + (width - 1) * inputs + 1 : inputs]
                    sums += every_pixel[:, None] * weight[term][None]
                return sums

            sums = _loop(len(weights), add_terms, jnp.zeros((width, LANES), x.dtype))
            pixels = sums.reshape(width, together, outputs).swapaxes(0, 1)
            return jax.lax.dynamic_update_slice(out, pixels[None], _place(image, top, 0, 0))

        return _loop(batch * blocks, each_rows, jnp.zeros((batch, height, width, outputs), x.dtype))

    return _compiled(convolved)(_rows(x, size), weights)


def _pull_kernel_in_turn(x, cotangent, size):
    batch, height, width, inputs = x.shape
    outputs = cotangent.shape[-1]
    together, window = LANES // outputs, size * inputs
    blocks, runs = -(-height // together), -(-width // TERMS)
    below, right = blocks * together - height, runs * TERMS - width
    cotangent = jnp.pad(cotangent, ((0, 0), (0, below), (0, right), (0, 0)))
    needed = size + together - 1  # rows of the image

    def correlated(x, cotangent):
        def each_rows(n, total):
            image, top = n // blocks, n % blocks * together

            def each_run(n, sums):
                left = n * TERMS
                pixels = _part(cotangent, (image, top, left, 0), (1, together, TERMS, outputs))[0]
                pixels = pixels.swapaxes(0, 1).reshape(TERMS, LANES)

                def with_terms(row, in_row):
                    run = _part(x, (image, top + row, left * inputs), (1, 1, (TERMS - 1) * inputs + window))[0, 0]
                    for term in range(TERMS):
                        in_row += run[term * inputs : term * inputs + window][:, None] * pixels[term][None]
                    return in_row

                return tuple(with_terms(row, in_row) for row, in_row in enumerate(sums))

            # A sum of sums: added to the total one by one, small values would lose their last digits.
            return jax.tree.map(jnp.add, total, _loop(runs, each_run, jax.tree.map(jnp.zeros_like, total)))

        return _loop(batch * blocks, each_rows, (jnp.zeros((window, LANES), x.dtype),) * needed)

    total = _compiled(correlated)(_rows(x, size, below, right), cotangent)
    total = jnp.stack(total).reshape(needed, size, inputs, together, outputs)
    return sum(total[row : row + size, :, :, row] for row in range(together))


def _rows(x: Float[Array, "B H W I"], size: int, below: int = 0, right: int = 0) -> Float[Array, "B R P"]:
    """Rows of pixels times channels, padded for a kernel of `size`, and further on two sides."""
    reach = size // 2
    padded = jnp.pad(x, ((0, 0), (reach, reach + below), (reach, reach + right), (0, 0)))
    return padded.reshape(*padded.shape[:2], -1)


def _place(*start):
    # Counters stay 32 bits wide where other integers are 64, and all of a place must be of one kind.
    return tuple(jnp.asarray(index, jnp.int32) for index in start)


def _part(array, start, shape):
    return jax.lax.dynamic_slice(array, _place(*start), shape)


def _compiled(function):
    return jax.custom_batching.sequential_vmap(one_function(function))


def _loop(steps, body, state):
    return jax.lax.fori_loop(jnp.int32(0), jnp.int32(steps), body, state)
