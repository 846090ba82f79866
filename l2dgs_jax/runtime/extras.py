"""Optional packages, which pip installs with an extra of this one."""

import importlib
from typing import Any

from l2dgs_jax.errors import UserError


def extra(package: str, name: str, use: str) -> Any:
    """Import an optional package.

    Args:
        package: to import.
        name: of the extra in pyproject.toml that installs it.
        use: what the extra is for, for the message.

    Raises:
        UserError: the package is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError:
        raise UserError(
            f'{package} is not installed; expected the extra for {use}: pip install "l2dgs-jax[{name}]"'
        ) from None
