"""Running out of memory, said in one sentence."""

import jax
import numpy as np
import pytest

from l2dgs_jax.errors import OUT_OF_MEMORY, UserError
from l2dgs_jax.runtime.memory import memory_errors


@pytest.mark.parametrize("demand", [lambda: np.empty(2**60, np.uint8), lambda: jax.numpy.zeros(2**55, np.uint8)])
def test_what_numpy_and_jax_raise_is_one_sentence(demand):
    with (
        pytest.raises(UserError, match=r"^out of memory here; expected less$") as caught,
        memory_errors(lambda: "here", "less"),
    ):
        demand()
    assert caught.value.code == OUT_OF_MEMORY


def test_other_errors_of_jax_pass():
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"), memory_errors(lambda: "here", "less"):
        raise jax.errors.JaxRuntimeError("INTERNAL: something else")
