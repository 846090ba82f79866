"""What pages of HTML that hold all they show have in common."""

import base64
import json
import mimetypes
import re
from typing import Any


def filled(template: str, **parts: str) -> str:
    """A template with something in the place of every hole; that of `part` is written __PART__."""
    return re.sub("__([A-Z_]+?)__", lambda hole: parts[hole[1].lower()], template)


def script_json(data: Any) -> str:
    """JSON that can stand in a script element: nothing in it ends the element."""
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


def data_url(content: bytes, name: str) -> str:
    """A picture or video as an address that holds it; the ending of `name` says what it is."""
    return f"data:{mimetypes.guess_type(name)[0]};base64,{base64.b64encode(content).decode()}"
