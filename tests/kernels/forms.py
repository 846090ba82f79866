"""Every form that an operation can take, as contexts to run a test in."""

import contextlib
import warnings

import jax
import pytest

from l2dgs_jax.kernels import selection, use_kernels

# None: what the platform decides. "untried": the same with a compiler that the fast forms were not tried with.
FORMS = ("reference", "cpu", "accelerator", None, "untried")


@contextlib.contextmanager
def form(name, monkeypatch):
    """Run what is traced within in one form."""
    if name == "untried":
        # What was compiled with the fast forms must not be found again.
        jax.clear_caches()
        monkeypatch.setattr(selection, "TRIED", False)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "jaxlib .* was not tried", RuntimeWarning)
            yield
        jax.clear_caches()
        return
    with use_kernels(name):
        yield


@pytest.fixture(params=FORMS, ids=str)
def any_form(request, monkeypatch):
    """The name of a form that the test runs in."""
    with form(request.param, monkeypatch):
        yield request.param
