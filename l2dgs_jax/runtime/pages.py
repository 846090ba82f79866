"""What pages of HTML that hold their own data have in common."""

import json
from typing import Any


def script_json(data: Any) -> str:
    """JSON that can stand in a script element: nothing in it ends the element."""
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
