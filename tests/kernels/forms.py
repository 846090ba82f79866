"""The forms of an operation, as contexts in which a test runs."""

import contextlib
import warnings

import jax
import pytest

from l2dgs_jax.kernels import selection, use_kernels

# None: what the platform decides, which is the form for CPUs here.
FORMS = ("reference", "accelerator", None)
# The form for CPUs chosen by name, and the form for a compiler that the kernels were not tested with.
OTHER_WAYS = ("cpu", pytest.param("untried", marks=pytest.mark.slow))


@contextlib.contextmanager
def form(name, monkeypatch):
    """Run what is traced within in one form."""
    if name != "untried":
        with use_kernels(name):
            yield
        return
    jax.clear_caches()  # programs compiled with the forms for CPUs must not be used again
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


@pytest.fixture(params=(*FORMS, *OTHER_WAYS), ids=str)
def any_way(request, monkeypatch):
    """The test runs in every form, chosen in every way."""
    with form(request.param, monkeypatch):
        yield request.param
