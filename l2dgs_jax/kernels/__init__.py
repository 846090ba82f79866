"""The operations that take most of the time, one a folder.

In each, `__init__` is the contract: what is computed, for which arguments, and with which gradient. `reference` says
it in the plainest way, `cpu` and `accelerator` in the way that suits such a machine. `selection` alone decides which of
the three runs; `compilation` alone knows how XLA's CPU compiler is told what to compile together.
"""

from l2dgs_jax.kernels.selection import Form, use_kernels

__all__ = ["Form", "use_kernels"]
