"""Which form runs: the setting, else the platform that a program is lowered for."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from l2dgs_jax.errors import UserError
from l2dgs_jax.kernels import selection, use_kernels
from l2dgs_jax.kernels.selection import by_form


def add(x, y):
    """x + a + 1, 2 or 4, depending on the form."""
    return by_form(
        x,
        y,
        reference=lambda x, y: {"sum": x + y["a"] + 1},
        cpu=lambda x, y: {"sum": x + y["a"] + 2},
        accelerator=lambda x, y: {"sum": x + y["a"] + 4},
        like={"sum": x},
    )["sum"]


X = jnp.arange(3.0)
Y = {"a": jnp.ones(3)}


def test_the_setting_also_decides_for_functions_compiled_before():
    compiled = jax.jit(add)
    for form, constant in (("reference", 1), ("cpu", 2), ("accelerator", 4), (None, 2), ("reference", 1)):
        with use_kernels(form):
            np.testing.assert_array_equal(compiled(X, Y), X + 1 + constant)
            np.testing.assert_array_equal(add(X, Y), X + 1 + constant)
    with use_kernels("accelerator"), use_kernels(None):
        np.testing.assert_array_equal(compiled(X, Y), X + 3)


@pytest.mark.parametrize("platform", ["cpu", "cuda", "rocm", "tpu"])
def test_without_a_setting_the_platform_lowered_for_decides(platform):
    text = jax.jit(add).trace(X, Y).lower(lowering_platforms=(platform,)).as_text()
    constants = {number for number in ("1", "2", "4") if f"dense<{number}.000000e+00>" in text}
    assert constants == {"2" if platform == "cpu" else "4"}


def test_one_program_for_two_platforms_contains_both_forms():
    text = jax.jit(add).trace(X, Y).lower(lowering_platforms=("cpu", "cuda")).as_text()
    assert "dense<2.000000e+00>" in text
    assert "dense<4.000000e+00>" in text


def test_only_the_form_that_runs_is_traced():
    def fail(x):
        raise AssertionError

    f = lambda x: by_form(x, reference=fail, cpu=jnp.sin, accelerator=fail, like=x)
    np.testing.assert_array_equal(jax.jit(f)(X), jnp.sin(X))


def test_vmap_over_any_axis_and_with_shared_arguments():
    x = jnp.arange(6.0).reshape(3, 2)
    np.testing.assert_array_equal(jax.jit(jax.vmap(add, (1, None), 1))(x, Y), x + 3)
    twice = jax.vmap(jax.vmap(add, (0, None)), (None, 0))(X, {"a": x})
    np.testing.assert_array_equal(twice, np.asarray(X)[None, :, None] + np.asarray(x)[:, None] + 2)


def test_an_untested_compiler_gets_the_general_form_with_one_warning(monkeypatch):
    monkeypatch.setattr(selection, "TESTED", False)
    selection._warn_of_untested_compiler.cache_clear()
    with pytest.warns(RuntimeWarning, match=r"jaxlib .* was not tried .*; expected jaxlib 0\.10"):
        np.testing.assert_array_equal(jax.jit(lambda x: add(x, Y))(X), X + 5)
    # Warnings are errors here: a second one would fail.
    np.testing.assert_array_equal(jax.jit(lambda x: add(x + 0, Y))(X), X + 5)


def test_an_unknown_form_is_refused():
    with pytest.raises(ValueError, match="expected one of reference, cpu, accelerator, or None"):
        use_kernels("gpu")


@pytest.mark.parametrize(("value", "constant"), [("accelerator", 4), ("", 2)])
def test_the_environment_sets_the_form_of_a_process(value, constant):
    program = (
        "import jax.numpy as jnp; from l2dgs_jax.kernels.selection import by_form;"
        "f = lambda k: lambda x: x + k;"
        "print(by_form(jnp.zeros(()), reference=f(1), cpu=f(2), accelerator=f(4), like=jnp.zeros(())))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], env={"PATH": "", selection.ENV_VARIABLE: value}, capture_output=True, text=True
    )
    assert float(done.stdout) == constant, done.stderr


def test_a_misspelt_environment_variable_is_refused_in_one_sentence(monkeypatch):
    monkeypatch.setenv(selection.ENV_VARIABLE, "fast")
    selection._from_environment.cache_clear()
    with pytest.raises(UserError, match="L2DGS_JAX_KERNELS is 'fast'; expected one of reference, cpu, accelerator"):
        add(X, Y)
    with use_kernels("reference"):
        add(X, Y)  # the environment is not read
    monkeypatch.undo()
    selection._from_environment.cache_clear()
