"""Convolution of few channels: every form compared with XLA's, alone and vmapped, with gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from l2dgs_jax.kernels.convolution import convolve

# Not multiples of the numbers of rows or pixels that are processed together.
SHAPES = [(5, 2, 8), (3, 8, 16), (3, 1, 16), (3, 16, 2), (7, 4, 4)]


def plain(x, kernel):
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))


def case(size, inputs, outputs, *batch):
    random = np.random.default_rng(size * inputs)
    shapes = (*batch, 2, 18, 21, inputs), (*batch, size, size, inputs, outputs), (*batch, 2, 18, 21, outputs)
    return tuple(jnp.asarray(random.normal(size=shape)) for shape in shapes)


def with_gradients(function):
    def both(x, kernel, cotangent):
        value, pull = jax.vjp(function, x, kernel)
        return value, *pull(cotangent)

    return both


def assert_close(actual, expected):
    for a, e in zip(actual, expected, strict=True):
        np.testing.assert_allclose(a, e, rtol=1e-12, atol=1e-12 * np.abs(e).max())


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_every_form_agrees_with_the_general_convolution(any_way, shape):
    arrays = case(*shape)
    assert_close(jax.jit(with_gradients(convolve))(*arrays), with_gradients(plain)(*arrays))


def test_vmapped_kernels_and_images_equal_a_loop(any_form):
    arrays = case(3, 4, 8, 3)
    alone = [
        jnp.stack(x) for x in zip(*(with_gradients(plain)(*(a[i] for a in arrays)) for i in range(3)), strict=True)
    ]
    assert_close(jax.jit(jax.vmap(with_gradients(convolve)))(*arrays), alone)
    x, kernels, _ = arrays
    shared = jax.jit(jax.vmap(convolve, (None, 0)))(x[0], kernels)
    np.testing.assert_allclose(shared, jnp.stack([plain(x[0], k) for k in kernels]), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("shape", [(1, 3, 8, 2), (1, 40, 8, 2), (3, 40, 5, 7), (3, 5, 4, 4)], ids=str)
def test_other_sizes_take_the_general_convolution(shape):
    size, width, inputs, outputs = shape
    random = np.random.default_rng(size)
    arrays = [jnp.asarray(random.normal(size=s)) for s in ((1, width, width, inputs), (size, size, inputs, outputs))]
    # They have forward gradients as well.
    actual, expected = (jax.jit(lambda *x, f=f: jax.jvp(f, x, x))(*arrays) for f in (convolve, plain))
    assert_close(actual, expected)


def test_single_precision_keeps_its_digits():
    """Summed one by one, the products of 32,000 pixels would be correct to four digits at most."""
    x, kernel, _ = case(3, 8, 8)
    x = jnp.tile(x, (1, 8, 5, 1)) + 1
    gradient = jax.grad(lambda kernel, x: convolve(x, kernel).sum())
    exact, single = gradient(kernel, x), jax.jit(gradient)(kernel.astype(jnp.float32), x.astype(jnp.float32))
    np.testing.assert_allclose(single, exact, rtol=3e-6)


def test_a_cotangent_known_to_be_zero_compiles():
    x, kernel, _ = case(3, 4, 4)
    gradient = jax.jit(jax.grad(lambda kernel, x: convolve(convolve(x, kernel), jnp.zeros_like(kernel)).sum()))
    np.testing.assert_array_equal(gradient(kernel, x), 0)


def test_no_images_give_an_empty_result_and_a_zero_gradient(any_form):
    x, kernel = jnp.ones((0, 18, 21, 4)), jnp.ones((3, 3, 4, 4))
    assert jax.jit(convolve)(x, kernel).shape == (0, 18, 21, 4)
    np.testing.assert_array_equal(jax.grad(lambda kernel: convolve(x, kernel).sum())(kernel), 0)


def test_a_nan_spreads_over_the_window(any_form):
    x, kernel, _ = case(3, 4, 4)
    broken = jax.jit(convolve)(x.at[0, 5, 7, 1].set(jnp.nan), kernel)
    assert np.isnan(broken[0, 4:7, 6:9]).all()
    assert not np.isnan(broken[1]).any()
