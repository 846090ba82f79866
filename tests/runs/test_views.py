"""Rendering views one after the other, with a progress bar."""

import io
import sys

import numpy as np
import pytest
from tiny_training import make_dataset

from l2dgs_jax.runs.run import Run
from l2dgs_jax.runs.views import views


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("quiet", [False, True])
def test_a_terminal_shows_a_progress_bar_unless_quiet(monkeypatch, quiet):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(Run, "renderer", lambda self, width, height: lambda camera: camera.time)
    cameras = make_dataset().train.cameras
    drawn = list(views(object.__new__(Run), cameras, quiet=quiet))
    np.testing.assert_array_equal(drawn, cameras.time)
    assert ("render" in terminal.getvalue()) != quiet
