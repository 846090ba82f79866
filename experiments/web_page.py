"""Self-contained pages, which need no server and no network: HTML templates filled with everything that they show."""

from pathlib import Path
from typing import Any

from l2dgs_jax.runtime.files import replacing
from l2dgs_jax.runtime.pages import filled, script_json

_ELEMENT = Path(__file__).with_name("element.js")


def write_page(path: Path, template: Path, data: Any) -> None:
    """Fill the placeholders __DATA__ and __ELEMENT__ of a template, which are in script elements.

    Raises:
        UserError: the page cannot be written.
    """
    with replacing(path) as temporary:
        page = filled(template.read_text(), data=script_json(data), element=_ELEMENT.read_text())
        temporary.write_text(page)
