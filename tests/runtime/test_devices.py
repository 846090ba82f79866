"""Settings made before jax starts."""

import importlib.util
import os
import types

import jaxlib
import pytest

from l2dgs_jax.runtime import devices


@pytest.mark.parametrize(
    ("plugin", "version", "before", "after"),
    [
        ("jax_cuda12_plugin", "0.10.2", None, "--xla_gpu_ftz=true"),
        ("jax_cuda13_plugin", "0.11.0rc1", "--other=1", "--other=1 --xla_gpu_ftz=true"),
        ("jax_cuda12_plugin", "0.11.1", "--other=1", "--other=1"),
        ("jax_cuda12_plugin", "0.10.2", "--xla_gpu_ftz=false", "--xla_gpu_ftz=false"),
        (None, "0.10.2", None, None),
    ],
)
def test_atomic_float_additions_are_enabled_for_cuda_where_needed(monkeypatch, plugin, version, before, after):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    if before:
        monkeypatch.setenv("XLA_FLAGS", before)
    found = lambda name: types.SimpleNamespace() if name == plugin else None
    monkeypatch.setattr(importlib.util, "find_spec", found)
    monkeypatch.setattr(jaxlib, "__version__", version)
    devices.use_atomic_additions()
    assert os.environ.get("XLA_FLAGS") == after
