"""Every test runs in float64 unless it says otherwise, with shapes and dtypes checked at run time."""

import os

# Most of a test's time is compilation, and most of that is optimisation. Whoever sets the variable decides.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 4)  # what runs on one device does not notice
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
install_import_hook("l2dgs_jax", "beartype.beartype")
