"""Reading values from JSON and NumPy files, with one-sentence errors."""

import json
import os
import reprlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from l2dgs_jax.errors import UserError

_JSON_NAMES: dict[type, str] = {dict: "object", list: "array", str: "string"}


def read_json(path: Path, what: str) -> dict[str, Any]:
    """The object in a JSON file; `what` says what it should describe.

    Raises:
        UserError: the file is missing, not JSON, or holds something else than an object.
    """
    if not os.path.isfile(path):
        raise UserError(f"{path}: no such file; expected {what}")
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path}: cannot be read as JSON ({error}); expected {what}") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: holds a JSON {type(content).__name__}; expected an object with {what}")
    return content


def read_array(path: Path, what: str, finite: bool = True) -> np.ndarray:
    """The real numbers in an .npy file, which must be finite unless `finite` is False; `what` describes them.

    Raises:
        UserError: the file is missing, damaged, or holds something else.
    """
    if not os.path.isfile(path):
        raise UserError(f"{path}: no such file; expected {what}")
    try:
        # Opened here, because numpy leaves some damaged files open.
        with open(path, "rb") as file:
            values = np.load(file, allow_pickle=False)
    except Exception as error:  # for damaged headers NumPy raises a dozen different types
        reason = str(error).partition("\n")[0]
        raise UserError(f"{path}: not a NumPy array of numbers ({reason}); expected {what}") from None
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "iuf":
        raise UserError(f"{path}: not a NumPy array of numbers; expected {what}")
    if finite and not np.isfinite(values).all():
        raise UserError(f"{path}: holds NaN or infinite values; expected finite numbers")
    return values


def value(path: Path | str, content: dict[str, Any], key: str, kind: type) -> Any:
    """The value of a key, which must have the type `kind`.

    Raises:
        UserError: it is missing or of another type.
    """
    if key not in content:
        raise UserError(f"{path}: '{key}' is missing; expected a JSON {_JSON_NAMES[kind]}")
    if not isinstance(content[key], kind):
        raise UserError(f"{path}: '{key}' is {reprlib.repr(content[key])}; expected a JSON {_JSON_NAMES[kind]}")
    return content[key]


def name_list(path: Path, content: dict[str, Any], key: str) -> list[str]:
    """The names in the list of a key.

    Raises:
        UserError: it is missing or not a list.
    """
    return [str(name) for name in value(path, content, key, list)]


def numbers(path: Path | str, content: dict[str, Any], key: str, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."]:
    """The finite numbers of a key, as an array of that shape; `path` may also say where in the file they are.

    Raises:
        UserError: the key is missing, or its value is something else.
    """
    wanted = f"{'x'.join(map(str, shape))} numbers" if shape else "a number"
    if key not in content:
        raise UserError(f"{path}: '{key}' is missing; expected {wanted}")
    try:
        values = np.asarray(content[key], np.float64)
    except (TypeError, ValueError, OverflowError):
        values = np.array(np.nan)
    if values.shape != shape or not np.isfinite(values).all():
        raise UserError(f"{path}: '{key}' is {reprlib.repr(content[key])}; expected {wanted}, finite")
    return values


def rotation(what: str, matrix: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Check that a matrix is a rotation, to about a thousandth, and return it; `what` names it in the message.

    Raises:
        UserError: it is not a rotation.
    """
    with np.errstate(all="ignore"):
        close = np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3)
    if not (close and np.linalg.det(matrix) > 0):
        raise UserError(f"{what} is not a rotation; expected an orthonormal matrix of determinant 1")
    return matrix
