"""The operations that take most of the time, each in a folder of its own.

In each folder, `__init__` is the contract: what is computed, for which arguments, and with which gradient. `reference`
is the plainest implementation; `cpu` and `accelerator` are those that suit such a machine. Only `selection` decides
which of the three forms runs, and only `compilation` controls what XLA's CPU compiler compiles together.
"""

from l2dgs_jax.kernels.selection import Form, use_kernels

__all__ = ["Form", "use_kernels"]
