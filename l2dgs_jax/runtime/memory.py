"""Running out of memory, said in one sentence."""

import contextlib
from collections.abc import Callable, Iterator

import jax

from l2dgs_jax.errors import OUT_OF_MEMORY, UserError


@contextlib.contextmanager
def memory_errors(reached: Callable[[], str], expected: str) -> Iterator[None]:
    """Turn running out of memory, of the host or of a device, into a sentence.

    Args:
        reached: how far the work has come, asked when it fails.
        expected: what would take less.

    Raises:
        UserError: the memory does not suffice.
    """
    try:
        yield
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise UserError(f"out of memory {reached()}; expected {expected}", OUT_OF_MEMORY) from None
