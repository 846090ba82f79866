"""Optional packages."""

import sys

import pytest

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.extras import extra


def test_a_package_is_imported_or_reported_missing_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "something", pytest)
    assert extra("something", "more", "more") is pytest
    monkeypatch.setitem(sys.modules, "something", None)
    with pytest.raises(UserError, match=r'^something .* the extra for seeing: pip install "l2dgs-jax\[view\]"$'):
        extra("something", "view", "seeing")
