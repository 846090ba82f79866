"""Time while a scene is played."""

import pytest

from l2dgs_jax.viewer.playhead import Playhead


def test_time_runs_on_from_where_it_was():
    assert Playhead(0.25, 10.0).at(12.0, duration=4.0, loop=False) == (0.75, True)


def test_time_stops_at_the_end_or_loops():
    assert Playhead(0.25, 10.0).at(14.0, duration=4.0, loop=False) == (1.0, False)
    instant, goes_on = Playhead(0.25, 10.0).at(14.0, duration=4.0, loop=True)
    assert instant == pytest.approx(0.25)
    assert goes_on
