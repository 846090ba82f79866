"""How the progress of a training is shown: as a bar on a terminal, lines in a log, JSON for programs, or not at all.

A display is called for every event, `display(event, **facts)`:

* begin: the training starts, resumes, or goes back, after `step` of `steps`;
* compiling: the program of a `stage` is compiled, before the first step that needs it;
* step: step number `step`, of a `stage`, is done; `left` seconds remain, or None if that is not known yet;
* metrics: the facts are a line of metrics;
* previews: pictures after a `step` have been written to `files` in the run folder;
* any other event: `message` says what has happened.
"""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from tqdm import tqdm

from l2dgs_jax.runtime.files import as_json

Display = Callable[..., None]

LOG_INTERVAL = 30  # seconds between lines in a log


@contextlib.contextmanager
def choose(quiet: bool = False, as_json: bool = False) -> Iterator[Display]:
    """The display that is asked for, or else the one that suits standard error.

    Within the block, other standard output goes to standard error if JSON is asked for, and is discarded if `quiet`.
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
    """A display that passes every event to all of these."""

    def tell(event: str, **facts: Any) -> None:
        for display in displays:
            display(event, **facts)

    return tell


def _as_json(event: str, facts: dict[str, Any]) -> str:
    """A JSON object and its newline, to be printed in one piece because several threads report events."""
    if event == "step":
        return ""
    return as_json(facts if event == "metrics" else {"event": event} | facts) + "\n"


class _Steps(tqdm):
    """A bar that shows `left`: tqdm's own estimate of the time left assumes that all steps take equally long."""

    left: float | None = None

    @property
    def format_dict(self) -> dict[str, Any]:
        return super().format_dict | {"left": "?" if self.left is None else tqdm.format_interval(self.left)}


class _Bar:
    """A progress bar on a terminal."""

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
    """A line in a log now and then."""

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
            self.due = now + LOG_INTERVAL
            left = f", {tqdm.format_interval(self.left)} left" if self.left else ""
            _write(f"{facts['stage']} {facts['step']}/{self.steps}: {_summary(facts)}{left}")
        elif "message" in facts:
            _write(facts["message"])


def _write(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _summary(line: dict[str, Any]) -> str:
    return f"loss {line['loss']:.3f}, low-light {line['psnr']:.1f} dB, {line['gaussians']} Gaussians"
