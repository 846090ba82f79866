"""Packages that are not part of the plain installation."""

import importlib
from typing import Any

from l2dgs_jax.errors import UserError


def extra(package: str, name: str, use: str) -> Any:
    """Import a package of an extra.

    Args:
        package: to import.
        name: of the extra in pyproject.toml.
        use: what the extra is for.

    Raises:
        UserError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError:
        raise UserError(
            f'{package} is not installed; expected the extra for {use}: pip install "l2dgs-jax[{name}]"'
        ) from None
