"""Every test runs in float64 unless it says otherwise, with shapes and dtypes checked at run time."""

import os
import shutil
from pathlib import Path

# Most of a test's time is compilation, and most of that is optimisation. Whoever sets the variable decides.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 4)  # tests on one device are not affected
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
install_import_hook("l2dgs_jax", "beartype.beartype")

MAPPINGS = Path("/proc/self/maps")


@pytest.fixture(scope="session")
def chromium():
    """Whatever drives the browser is skipped where it is missing."""
    if not shutil.which("chromium"):
        pytest.skip("needs Chromium")


@pytest.fixture(autouse=True, scope="module")
def _room_for_programs():
    """A process may have 65,530 mappings under Linux, and every compiled program takes some of them."""
    yield
    if MAPPINGS.exists() and MAPPINGS.read_bytes().count(b"\n") > 30_000:
        jax.clear_caches()
