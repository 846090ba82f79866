"""Selecting rows of arrays, and expanding them to the full size again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.model import compaction
from l2dgs_jax.model.compaction import expand, highest, map_chosen, select

SCORES = np.array([0.1, 3.0, -np.inf, 2.0, -1.0, 5.0])
ROWS = [1, 3, 5]


@pytest.fixture(scope="module")
def subset():
    return highest(jnp.asarray(SCORES), 3)


def test_the_highest_are_chosen_and_keep_their_order(subset):
    np.testing.assert_array_equal(subset.rows, ROWS)
    np.testing.assert_array_equal(subset.places, [3, 0, 3, 1, 3, 2])


@pytest.mark.parametrize("axis", [0, 1])
def test_expand_puts_selected_rows_back_in_place(subset, axis):
    values = np.random.default_rng(0).normal(size=(6, 6))
    selected = select(jnp.asarray(values), subset, axis)
    np.testing.assert_array_equal(selected, np.take(values, ROWS, axis))
    kept = np.zeros(6)
    kept[ROWS] = 1
    expected = values * (kept[:, None] if axis == 0 else kept)
    np.testing.assert_array_equal(expand(selected, subset, axis), expected)


@pytest.mark.parametrize("function", [select, expand])
def test_gradients(subset, function):
    values = jnp.asarray(np.random.default_rng(1).normal(size=(2, 6 if function is select else 3, 2)))
    check_grads(jax.jit(lambda x: function(x, subset, 1) ** 2), (values,), 1, ["rev"])


MANY = 2 * compaction.CHUNKS + 1  # the last chunk is not full


def motion(shared, rows):
    """A function of each row alone, with results of two shapes, the axis of the rows second."""
    weight, offset = shared
    first, second = rows
    hidden = jnp.tanh(first @ weight)
    return hidden[None] + offset[:, None, None], (second * hidden[:, 0])[None] * offset[:, None]


def motion_inputs(seed=0):
    rng = np.random.default_rng(seed)
    shared = (rng.normal(size=(3, 4)), rng.normal(size=2))
    return jax.tree.map(jnp.asarray, (shared, (rng.normal(size=(MANY, 3)), rng.normal(size=MANY))))


def chosen_rows(count):
    return jnp.asarray(np.random.default_rng(3).permutation(MANY) < count)


@pytest.mark.parametrize("count", [0, 1, 3, 20, MANY])
def test_only_the_chosen_rows_are_mapped(count):
    shared, rows = motion_inputs()
    chosen = chosen_rows(count)
    for result, full in zip(map_chosen(motion, shared, rows, chosen), motion(shared, rows), strict=True):
        mask = np.asarray(chosen).reshape(1, -1, *[1] * (full.ndim - 2))
        np.testing.assert_allclose(result, np.where(mask, full, 0), rtol=1e-12)
        np.testing.assert_array_equal(np.asarray(result)[:, ~chosen], 0)


@pytest.mark.parametrize("count", [0, 20, MANY])
def test_gradients_of_a_map(count):
    shared, rows = motion_inputs()
    chosen = chosen_rows(count)
    check_grads(jax.jit(lambda *x: map_chosen(motion, *x, chosen)), (shared, rows), 1, ["rev"])


@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_what_other_rows_hold_reaches_no_gradient(value):
    shared, (first, second) = motion_inputs()
    chosen = chosen_rows(20)
    total = lambda shared, rows: sum(x.sum() for x in map_chosen(motion, shared, rows, chosen))
    expected = jax.grad(total, (0, 1))(shared, (first, second))
    other = ~chosen
    gradient = jax.grad(total, (0, 1))(
        shared, (jnp.where(other[:, None], value, first), jnp.where(other, value, second))
    )
    jax.tree.map(np.testing.assert_array_equal, gradient, expected)


def test_a_map_takes_as_many_chunks_as_there_are_chosen_rows_in_one_program():
    calls, traces, traced = [], [], 0

    def function(shared, rows):
        traces.append(None)
        jax.debug.callback(lambda: calls.append(None))
        return motion(shared, rows)

    mapped = jax.jit(lambda chosen: map_chosen(function, *motion_inputs(), chosen))
    length = -(-MANY // compaction.CHUNKS)
    for count in (0, 1, length, length + 1, MANY):
        calls.clear()
        jax.block_until_ready(mapped(chosen_rows(count)))
        jax.effects_barrier()
        assert len(calls) == -(-count // length)
        traced = traced or len(traces)
    assert len(traces) == traced


def test_maps_with_different_numbers_of_rows_run_side_by_side():
    inputs = [motion_inputs(seed) for seed in (0, 1)]
    chosen = [chosen_rows(count) for count in (2, 30)]
    together = jax.tree.map(lambda *x: jnp.stack(x), *inputs)
    results = jax.vmap(lambda shared, rows, chosen: map_chosen(motion, shared, rows, chosen))(
        *together, jnp.stack(chosen)
    )
    for member, (own, rows) in enumerate(zip(inputs, chosen, strict=True)):
        for result, expected in zip(results, map_chosen(motion, *own, rows), strict=True):
            np.testing.assert_allclose(result[member], expected, rtol=1e-12)
