"""Displays of the progress of a training."""

import io
import json
import sys

import pytest

from l2dgs_jax.runs import displays

LINE = {"step": 10, "stage": "coarse", "gaussians": 7, "loss": 0.5, "psnr": 30.0}


def show(display, steps=40):
    """Send the events of a training whose steps take a second each."""
    display("begin", step=0, steps=steps)
    display("compiling", stage="coarse")
    for step in range(1, steps + 1):
        display("step", step=step, stage="coarse", left=3.0 * (steps - step) if step > 1 else None)
        if step % 10 == 0:
            display("metrics", **LINE | {"step": step})
        display.passes(1)
    display("diverged", message="going back", step=0)


class Clocked:
    """A display with a clock that the test sets."""

    def __init__(self, display, monkeypatch):
        self.display, self.now = display, 1000.0
        monkeypatch.setattr(displays.time, "monotonic", lambda: self.now)

    def __call__(self, event, **facts):
        self.display(event, **facts)

    def passes(self, seconds):
        self.now += seconds


def test_a_log_has_occasional_lines_with_the_time_left(monkeypatch, capsys):
    with displays.choose() as display:
        show(Clocked(display, monkeypatch))
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors.splitlines() == [
        "compiling the coarse stage",
        "coarse 10/40: loss 0.500, low-light 30.0 dB, 7 Gaussians, 01:30 left",
        "coarse 40/40: loss 0.500, low-light 30.0 dB, 7 Gaussians",
        "going back",
    ]


def test_only_json_goes_to_standard_output(monkeypatch, capsys):
    with displays.choose(as_json=True) as display:
        print("for people")
        show(Clocked(display, monkeypatch), steps=10)
    output, errors = capsys.readouterr()
    assert [json.loads(line) for line in output.splitlines()] == [
        {"event": "begin", "step": 0, "steps": 10},
        {"event": "compiling", "stage": "coarse"},
        LINE,
        {"event": "diverged", "message": "going back", "step": 0},
    ]
    assert errors == "for people\n"


def test_quiet_shows_nothing(monkeypatch, capsys):
    with displays.choose(quiet=True) as display:
        print("for people")
        show(Clocked(display, monkeypatch))
    assert capsys.readouterr() == ("", "")


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_shows_a_progress_bar(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with displays.choose() as display:
        display("begin", step=10, steps=40)
        display("compiling", stage="fine")
        assert "compiling the fine stage:  25%" in terminal.getvalue()
        display("step", step=11, stage="fine", left=None)
        display("metrics", **LINE)
        assert "30.0 dB" in terminal.getvalue().split("\r")[-1]
        display("step", step=12, stage="fine", left=754.0)
        display("metrics", **LINE)
        assert "<12:34" in terminal.getvalue().split("\r")[-1]
        display("diverged", message="going back")
        display("begin", step=0, steps=40)
        display("step", step=1, stage="coarse", left=None)
        assert display.bar.n == 1
    assert "going back" in terminal.getvalue()


@pytest.mark.parametrize("options", [{}, {"quiet": True}, {"as_json": True}])
def test_messages_before_the_first_step_are_shown_unless_quiet(options, capsys):
    with displays.choose(**options) as display:
        display("stopping", message="soon")
    assert ("soon" in "".join(capsys.readouterr())) == ("quiet" not in options)
