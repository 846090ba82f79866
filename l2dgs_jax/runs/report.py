"""report.html: a page in the run folder that shows the progress of the training, and reloads itself meanwhile."""

import contextlib
import html
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from l2dgs_jax.errors import UserError
from l2dgs_jax.runs import previews
from l2dgs_jax.runs.folder import CONTACT_SHEET, VIDEO, read_metrics
from l2dgs_jax.runs.recorder import terms
from l2dgs_jax.runtime.files import replacing
from l2dgs_jax.runtime.pages import data_url, filled, script_json

REPORT = "report.html"
WRITE_INTERVAL = 15  # seconds
CURVE_POINTS = 400  # of a curve, about
TEMPLATE = Path(__file__).with_name(REPORT)


class Report:
    """A display (see `displays`) that writes the page.

    If the page cannot be written it is tried again the next time: no training should fail because of its report.
    """

    def __init__(self, folder: Path):
        """Write nothing before the first event.

        Args:
            folder: of the run, which exists.
        """
        self.folder, self.due = folder, 0.0
        self.lines: list[dict[str, Any]] = []
        self.shown: dict[str, Any] = {"running": True, "step": 0, "left": None}

    def __call__(self, event: str, **facts: Any) -> None:
        """Process an event, and write the page if that is due."""
        if event == "stopping":  # reported by another thread; "end" follows
            return
        if event == "start":
            self.shown |= {"scene": facts["scene"], "run": facts["run"]}
        elif event == "begin":
            self.lines = read_metrics(self.folder)
            self.shown |= {"step": facts["step"], "steps": facts["steps"]}
        elif event == "compiling":
            self.shown["state"] = f"compiling the {facts['stage']} stage"
        elif event == "step":
            self.shown |= {"state": f"{facts['stage']} stage", "step": facts["step"], "left": facts["left"]}
        elif event == "metrics":
            self.lines.append(facts)
        elif event == "diverged":
            self.shown["note"] = facts["message"]
        elif event == "end":
            self.shown |= {"running": False, "state": facts.get("reason", "finished"), "left": None}
        if event not in ("step", "metrics") or time.monotonic() >= self.due:
            with contextlib.suppress(UserError, OSError, UnicodeError):
                self.write()
            self.due = time.monotonic() + WRITE_INTERVAL

    def write(self) -> None:
        """Write the page.

        Raises:
            UserError: it cannot be written.
        """
        results = sorted(path.name for name in (CONTACT_SHEET, f"{VIDEO}.*") for path in self.folder.glob(name))
        content = self.shown | {
            "updated": time.time(),
            "interval": WRITE_INTERVAL,
            "results": results,
            "curves": curves(self.lines),
            "views": _views(self.folder),
        }
        with replacing(self.folder / REPORT) as temporary:
            title = html.escape(self.shown.get("scene", ""))
            temporary.write_text(filled(TEMPLATE.read_text(), title=title, data=script_json(content)))


def curves(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Columns of a run's metrics; for a long run of every second line, every third ..., and always of the last.

    Returns:
        Columns "step", "loss", "psnr", "gaussians" and "memory"; dictionaries of columns "terms" (unweighted) and
        "rates"; and "fine", the first step of the fine stage that has a line, or None. Columns have None where a line
        lacks a value or has one that is not finite.
    """
    thinned = lines[:: -max(1, len(lines) // CURVE_POINTS)][::-1]
    groups = {"terms": [terms(line) for line in thinned], "rates": [line.get("rates", {}) for line in thinned]}
    return {
        "step": [line["step"] for line in thinned],
        "fine": next((line["step"] for line in thinned if line["stage"] == "fine"), None),
        **{name: _column(thinned, name) for name in ("loss", "psnr", "gaussians", "memory")},
        **{
            group: {name: _column(rows, name) for name in sorted({name for row in rows for name in row})}
            for group, rows in groups.items()
        },
    }


def _column(lines: Sequence[dict[str, Any]], name: str) -> list[int | float | None]:
    values = (line.get(name) for line in lines)
    return [value if value is not None and math.isfinite(value) else None for value in values]


def _views(folder: Path) -> list[dict[str, Any]]:
    """The previews of each view as data URLs: the input frame, and the pictures of every step."""
    views: dict[str, dict[str, Any]] = {}
    for view, kind, step, path in previews.kept(folder):
        encoded = data_url(path.read_bytes(), path.name)
        entry = views.setdefault(view, {"name": view, "frame": None, "steps": {}})
        if step is None:
            entry["frame"] = encoded
        else:
            entry["steps"].setdefault(step, {})[kind] = encoded
    return list(views.values())
