"""Packages that may be missing."""

import sys

import pytest

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.extras import extra


def test_what_is_there_is_imported_and_what_is_not_is_named_with_its_cure(monkeypatch):
    monkeypatch.setitem(sys.modules, "something", pytest)
    assert extra("something", "more", "more") is pytest
    monkeypatch.setitem(sys.modules, "something", None)
    with pytest.raises(UserError, match=r'^something .* the extra for seeing: pip install "l2dgs-jax\[view\]"$'):
        extra("something", "view", "seeing")
