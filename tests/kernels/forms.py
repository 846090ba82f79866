"""The forms that an operation can take, as contexts to run a test in."""

import contextlib
import warnings

import jax
import pytest

from l2dgs_jax.kernels import selection, use_kernels

# None: what the platform decides, which is the form for CPUs here.
FORMS = ("reference", "accelerator", None)
# The form for CPUs asked for by name, and what a compiler gets that it was not tried with.
ROUNDABOUT = ("cpu", pytest.param("untried", marks=pytest.mark.slow))


@contextlib.contextmanager
def form(name, monkeypatch):
    """Run what is traced within in one form."""
    if name != "untried":
        with use_kernels(name):
            yield
        return
    jax.clear_caches()  # what was compiled with the forms for CPUs must not be found again
    monkeypatch.setattr(selection, "TESTED", False)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "jaxlib .* was not tried", RuntimeWarning)
        yield
    jax.clear_caches()


@pytest.fixture(params=FORMS, ids=str)
def any_form(request, monkeypatch):
    """The test runs in every form."""
    with form(request.param, monkeypatch):
        yield request.param


@pytest.fixture(params=(*FORMS, *ROUNDABOUT), ids=str)
def any_way(request, monkeypatch):
    """The test runs in every form, whichever way one comes to it."""
    with form(request.param, monkeypatch):
        yield request.param
