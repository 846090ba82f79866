"""Pages that need no server and no network: HTML from a file beside the script, with all that it shows inside."""

from pathlib import Path
from typing import Any

from l2dgs_jax.runtime.files import replacing
from l2dgs_jax.runtime.pages import filled, script_json


def write_page(path: Path, template: Path, data: Any) -> None:
    """Fill the hole __DATA__ of a template, which stands in a script element.

    Raises:
        UserError: the page cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_text(filled(template.read_text(), data=script_json(data)))
