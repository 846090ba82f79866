"""Selecting rows of arrays, and expanding them to the full size again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.model.compaction import expand, highest, select

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
