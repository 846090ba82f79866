"""How a training shows itself: by a bar on a terminal, lines in a log, JSON for programs, or not at all.

A display is told of events, `display(event, **facts)`:

* begin: it goes on after `step` of `steps`, at first and when it was put back;
* compiling: the program of a `stage`, before the first step that needs it;
* step: that of number `step`, of a `stage`, is done, and `left` seconds are if that is known yet;
* metrics: the facts are a line of metrics;
* previews: the pictures after a `step` have been drawn, to `files` in the run folder;
* any other: something has happened, and `message` says what.
"""

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from tqdm import tqdm

Display = Callable[..., None]

INTERVAL = 30  # seconds between lines in a log


@contextlib.contextmanager
def choose(quiet: bool = False, as_json: bool = False) -> Iterator[Display]:
    """The display that is asked for, or else the one that suits standard error.

    Within the block standard output is for JSON alone where that is asked for, and leads nowhere where all is quiet.
    """
    if as_json:
        output = sys.stdout
        with contextlib.redirect_stdout(sys.stderr):
            yield lambda event, **facts: print(_as_json(event, facts), end="", file=output, flush=True)
    elif quiet:
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
            yield lambda event, **facts: None
    elif sys.stderr.isatty():
        with contextlib.closing(_Bar()) as bar:
            yield bar
    else:
        yield _Log()


def together(displays: Sequence[Display]) -> Display:
    """A display that tells all of these."""

    def tell(event: str, **facts: Any) -> None:
        for display in displays:
            display(event, **facts)

    return tell


def _as_json(event: str, facts: dict[str, Any]) -> str:
    """An object and its newline, to be printed in one piece: threads tell things too."""
    if event == "step":
        return ""
    return json.dumps(facts if event == "metrics" else {"event": event} | facts) + "\n"


class _Steps(tqdm):
    """tqdm's own time left takes all steps for alike."""

    left: float | None = None

    @property
    def format_dict(self) -> dict[str, Any]:
        return super().format_dict | {"left": "?" if self.left is None else tqdm.format_interval(self.left)}


class _Bar:
    """A bar with the time left."""

    def __init__(self) -> None:
        self.bar: _Steps | None = None
        self.compiling = False

    def __call__(self, event: str, **facts: Any) -> None:
        if event == "begin":
            form = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{left}, {rate_fmt}{postfix}]"
            self.bar = self.bar or _Steps(
                total=facts["steps"], initial=facts["step"], unit="step", dynamic_ncols=True, bar_format=form
            )
            self.bar.update(facts["step"] - self.bar.n)
        elif self.bar and event == "compiling":
            self.compiling = True
            self.bar.set_description(f"compiling the {facts['stage']} stage")
        elif self.bar and event == "step":
            if self.compiling:
                self.compiling = False
                self.bar.unpause()
                self.bar.set_description(facts["stage"], refresh=False)
            self.bar.left = facts["left"]
            self.bar.update()
        elif self.bar and event == "metrics":
            self.bar.set_postfix_str(_summary(facts))
        elif "message" in facts:
            tqdm.write(facts["message"], file=sys.stderr)

    def close(self) -> None:
        if self.bar:
            self.bar.close()


class _Log:
    """A line now and then."""

    def __init__(self) -> None:
        self.steps, self.due = 0, 0.0
        self.left: float | None = None

    def __call__(self, event: str, **facts: Any) -> None:
        now = time.monotonic()
        if event == "begin":
            self.steps = facts["steps"]
        elif event == "compiling":
            _write(f"compiling the {facts['stage']} stage")
        elif event == "step":
            self.left = facts["left"]
        elif event == "metrics" and (now >= self.due or facts["step"] == self.steps):
            self.due = now + INTERVAL
            left = f", {tqdm.format_interval(self.left)} left" if self.left else ""
            _write(f"{facts['stage']} {facts['step']}/{self.steps}: {_summary(facts)}{left}")
        elif "message" in facts:
            _write(facts["message"])


def _write(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _summary(line: dict[str, Any]) -> str:
    return f"loss {line['loss']:.3f}, low-light {line['psnr']:.1f} dB, {line['gaussians']} Gaussians"
