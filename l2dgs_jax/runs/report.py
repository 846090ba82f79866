"""report.html: a page in the run folder that shows how its training goes, and reloads itself while it does."""

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
INTERVAL = 15  # seconds between two writings
POINTS = 400  # of a curve, about
TEMPLATE = Path(__file__).with_name(REPORT)


class Report:
    """A display (see `displays`) that is such a page.

    What cannot be written is written the next time: no training should end for its report.
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
        """Take it in, and write the page if that is due."""
        if event == "stopping":  # told by another thread; the end follows
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
            with contextlib.suppress(UserError, OSError):
                self.write()
            self.due = time.monotonic() + INTERVAL

    def write(self) -> None:
        """Write the page.

        Raises:
            UserError: it cannot be written.
        """
        results = sorted(path.name for name in (CONTACT_SHEET, f"{VIDEO}.*") for path in self.folder.glob(name))
        content = self.shown | {
            "updated": time.time(),
            "interval": INTERVAL,
            "results": results,
            "curves": curves(self.lines),
            "views": _views(self.folder),
        }
        with replacing(self.folder / REPORT) as temporary:
            title = html.escape(self.shown.get("scene", ""))
            temporary.write_text(filled(TEMPLATE.read_text(), title=title, data=script_json(content)))


def curves(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Columns of a run's metrics; of a long run's every second line, or third ..., and always the last.

    Returns:
        Columns "step", "loss", "psnr", "gaussians" and "memory", and by name those of "terms" (unweighted) and "rates",
        None where a line lacks a value or has one that is not finite; and "fine", the first step of the fine stage that
        has a line, or None.
    """
    thinned = lines[:: -max(1, len(lines) // POINTS)][::-1]
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
    """The previews by view: the frame, and the pictures of every step, as data URIs."""
    views: dict[str, dict[str, Any]] = {}
    for view, kind, step, path in previews.kept(folder):
        encoded = data_url(path.read_bytes(), path.name)
        entry = views.setdefault(view, {"name": view, "frame": None, "steps": {}})
        if step is None:
            entry["frame"] = encoded
        else:
            entry["steps"].setdefault(step, {})[kind] = encoded
    return list(views.values())
