"""Helpers for self-contained HTML pages, which hold everything that they show."""

import base64
import json
import mimetypes
import re
from typing import Any


def filled(template: str, **parts: str) -> str:
    """A template with every placeholder replaced: __NAME__ by the part called `name`."""
    return re.sub("__([A-Z_]+?)__", lambda hole: parts[hole[1].lower()], template)


def script_json(data: Any) -> str:
    """JSON that is safe inside a script element: nothing in it can end the element."""
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


def data_url(content: bytes, name: str) -> str:
    """A data URL that holds a picture or video; the suffix of `name` gives its type."""
    return f"data:{mimetypes.guess_type(name)[0]};base64,{base64.b64encode(content).decode()}"
