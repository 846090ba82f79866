import jax
import jax.numpy as jnp
import numpy as np
from jax.test_util import check_grads

from l2dgs_jax.kernels import loops
from l2dgs_jax.kernels.compilation import native_call, unfused
from l2dgs_jax.kernels.fusion import fusion_boundary, repeat_channels


def test_adding_rows_one_by_one_equals_a_scatter():
    random = np.random.default_rng(0)
    table, rows = jnp.asarray(random.normal(size=(7, 3))), jnp.asarray(random.normal(size=(4, 5, 3)))
    ids = jnp.asarray(random.integers(0, 7, (4, 5)), jnp.int32)  # 20 rows into 7: most are hit more than once
    added = jax.jit(native_call(loops.add_rows))(table, ids, rows)
    np.testing.assert_allclose(added, table.at[ids].add(rows), rtol=1e-14)


def test_native_calls_and_unfused_functions_compute_the_same():
    def function(x, y):
        return {"sum": jax.lax.fori_loop(0, 5, lambda i, total: total + jnp.sin(i * x) * y, y), "x": 2 * x}

    x, y = jnp.linspace(0, 1, 24).reshape(4, 6), jnp.ones((4, 6))
    expected = function(x, y)
    for compiled in (native_call(function), unfused(function)):
        actual = jax.jit(lambda x, y, f=compiled: f(x + 1 - 1, y))(x, y)
        jax.tree.map(lambda a, e: np.testing.assert_allclose(a, e, rtol=1e-13), actual, expected)


def test_channels_are_repeated_and_the_gradient_sums_over_them():
    x = jnp.asarray(np.random.default_rng(1).normal(size=(2, 3)))
    np.testing.assert_array_equal(repeat_channels(x, 4), np.repeat(x[..., None], 4, axis=-1))
    check_grads(jax.jit(lambda x: repeat_channels(x, 4) ** 2), (x,), order=1)


def test_a_fusion_boundary_keeps_values_and_gradients():
    function = lambda x, pair: (x * pair[0], {"sum": jnp.sin(pair[1]) + x})
    arguments = jnp.linspace(0.5, 2, 5), (jnp.linspace(-1, 1, 5), jnp.linspace(2, 3, 5))
    for staged in (fusion_boundary(function), jax.vmap(fusion_boundary(function))):
        jax.tree.map(np.testing.assert_array_equal, jax.jit(staged)(*arguments), function(*arguments))
        check_grads(jax.jit(staged), arguments, order=1, modes=("rev",))
