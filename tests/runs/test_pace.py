"""The estimated time left of trainings whose steps have given durations."""

import dataclasses

import numpy as np
import pytest
from tiny_training import tiny

from l2dgs_jax.config import DensityConfig
from l2dgs_jax.runs import pace

BIRTHS = DensityConfig(method="mcmc", start=50, stop=400, interval=50, max_gaussians=30_000)
NO_GROWTH = DensityConfig(stop=0)


def times_left(monkeypatch, config, durations, gaussians=10_000, done=0):
    """The estimated time left after each step, and the true one."""
    now = 100.0
    monkeypatch.setattr(pace.time, "monotonic", lambda: now)
    left, clock = [], pace.Pace(config, done, gaussians)
    for step, seconds in enumerate(durations, done + 1):
        now += seconds
        left.append(clock(step))
    return left, durations[::-1].cumsum()[::-1] - durations


def test_fine_steps_are_estimated_before_any_is_timed(monkeypatch):
    config = tiny(coarse_steps=100, fine_steps=300, density=NO_GROWTH)
    left, expected = times_left(monkeypatch, config, np.where(np.arange(400) < 100, 0.1, 0.1 * pace.FINE_STEP))
    np.testing.assert_allclose(left[1:], expected[1:], atol=1e-6)


def test_an_unexpectedly_slow_stage_is_estimated_once_it_is_timed(monkeypatch):
    config = tiny(coarse_steps=100, fine_steps=300, density=NO_GROWTH)
    left, expected = times_left(monkeypatch, config, np.where(np.arange(400) < 100, 0.1, 0.5))
    np.testing.assert_allclose(left[100 + pace.TIMED_STEPS :], expected[100 + pace.TIMED_STEPS :], atol=1e-6)


def test_births_to_come_are_included_in_the_estimate(monkeypatch):
    config = tiny(coarse_steps=20, fine_steps=480, density=BIRTHS)
    births = 3 ** (np.arange(1, 7) / 6).repeat(50)  # after steps 100, 150 ... 350 of the fine stage
    gaussians = 10_000 * np.concatenate([np.ones(120), births, np.full(80, 3.0)])
    durations = 1e-5 * (pace.FIXED_COST + gaussians) * np.where(np.arange(500) < 20, 1, pace.FINE_STEP)
    left, expected = times_left(monkeypatch, config, durations)
    assert left[30] == pytest.approx(expected[30], rel=1e-3)
    without_births = (500 - 31) * durations[30]
    assert expected[30] > 1.2 * without_births


@pytest.mark.parametrize("done", [0, 7, 40, 70])
def test_compilations_and_checkpoints_do_not_count(monkeypatch, done):
    config = dataclasses.replace(tiny(coarse_steps=40, fine_steps=60), density=NO_GROWTH)
    durations = np.full(100 - done, 0.1)
    durations[0], durations[20] = 60, 5
    if done < 40:
        durations[40 - done] = 30
    left, _ = times_left(monkeypatch, config, durations, done=done)
    assert left[0] is None
    assert max(left[1:]) < 0.1 * pace.FINE_STEP * 100
    assert left[-1] == 0
