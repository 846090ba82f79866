"""Memory in use, and the errors of running out of it."""

import jax
import numpy as np
import pytest

from l2dgs_jax.errors import OUT_OF_MEMORY, UserError
from l2dgs_jax.runtime.memory import memory_errors, memory_in_use


@pytest.mark.parametrize("demand", [lambda: np.empty(2**60, np.uint8), lambda: jax.numpy.zeros(2**55, np.uint8)])
def test_memory_errors_of_numpy_and_jax_become_one_sentence(demand):
    with (
        pytest.raises(UserError, match=r"^out of memory here; expected less$") as caught,
        memory_errors(lambda: "here", "less"),
    ):
        demand()
    assert caught.value.code == OUT_OF_MEMORY


def test_memory_in_use_grows_with_what_is_held():
    before = memory_in_use()
    held = np.ones(2**24)
    assert before + 0.9 * held.nbytes < memory_in_use() < before + 2 * held.nbytes


def test_other_errors_of_jax_pass_through():
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"), memory_errors(lambda: "here", "less"):
        raise jax.errors.JaxRuntimeError("INTERNAL: something else")
