"""The time left of trainings whose every step takes as long as the test says."""

import dataclasses

import numpy as np
import pytest
from tiny_training import tiny

from l2dgs_jax.config import DensityConfig
from l2dgs_jax.runs import pace

BIRTHS = DensityConfig(method="mcmc", start=50, stop=400, interval=50, max_gaussians=30_000)
STILL = DensityConfig(stop=0)


def told(monkeypatch, config, durations, gaussians=10_000, done=0):
    """What is left after each step, and what should be."""
    now = 100.0
    monkeypatch.setattr(pace.time, "monotonic", lambda: now)
    left, clock = [], pace.Pace(config, done, gaussians)
    for step, seconds in enumerate(durations, done + 1):
        now += seconds
        left.append(clock(step))
    return left, durations[::-1].cumsum()[::-1] - durations


def test_a_fine_step_is_dearer_than_a_coarse_one_before_any_is_timed(monkeypatch):
    config = tiny(coarse_steps=100, fine_steps=300, density=STILL)
    left, expected = told(monkeypatch, config, np.where(np.arange(400) < 100, 0.1, 0.1 * pace.FINE_STEP))
    np.testing.assert_allclose(left[1:], expected[1:], atol=1e-6)


def test_a_stage_that_takes_longer_than_thought_is_believed_once_it_is_timed(monkeypatch):
    config = tiny(coarse_steps=100, fine_steps=300, density=STILL)
    left, expected = told(monkeypatch, config, np.where(np.arange(400) < 100, 0.1, 0.5))
    np.testing.assert_allclose(left[100 + pace.TIMED_STEPS :], expected[100 + pace.TIMED_STEPS :], atol=1e-6)


def test_births_ahead_are_counted(monkeypatch):
    config = tiny(coarse_steps=20, fine_steps=480, density=BIRTHS)
    births = 3 ** (np.arange(1, 7) / 6).repeat(50)  # after steps 100, 150 ... 350 of the fine stage
    gaussians = 10_000 * np.concatenate([np.ones(120), births, np.full(80, 3.0)])
    durations = 1e-5 * (pace.FIXED_COST + gaussians) * np.where(np.arange(500) < 20, 1, pace.FINE_STEP)
    left, expected = told(monkeypatch, config, durations)
    assert left[30] == pytest.approx(expected[30], rel=1e-3)
    unaware = (500 - 31) * durations[30]
    assert expected[30] > 1.2 * unaware


@pytest.mark.parametrize("done", [0, 7, 40, 70])
def test_compilations_and_checkpoints_do_not_count(monkeypatch, done):
    config = dataclasses.replace(tiny(coarse_steps=40, fine_steps=60), density=STILL)
    durations = np.full(100 - done, 0.1)
    durations[0], durations[20] = 60, 5
    if done < 40:
        durations[40 - done] = 30
    left, _ = told(monkeypatch, config, durations, done=done)
    assert left[0] is None
    assert max(left[1:]) < 0.1 * pace.FINE_STEP * 100
    assert left[-1] == 0
