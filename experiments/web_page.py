"""Pages that need no server and no network: HTML from a file beside the script, with all that it shows inside."""

import base64
import mimetypes
from pathlib import Path
from typing import Any

from l2dgs_jax.runtime.files import replacing
from l2dgs_jax.runtime.pages import script_json

HOLE = "__DATA__"  # in a script element of the type application/json


def write_page(path: Path, template: Path, data: Any) -> None:
    """Fill the hole of a template.

    Raises:
        UserError: the page cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_text(template.read_text().replace(HOLE, script_json(data)))


def data_url(content: bytes, name: str) -> str:
    """A picture or video as an address that holds it; the ending of `name` says what it is."""
    return f"data:{mimetypes.guess_type(name)[0]};base64,{base64.b64encode(content).decode()}"
