"""When a loss counts as exploded."""

import json
from pathlib import Path

import pytest

from l2dgs_jax.runs.divergence import EXPLODED_LINES, EXPLOSION_FACTOR, USUAL_LINES, explosion

# Losses of healthy trainings that come nearest to an explosion: every tenth step, with the start of the fine stage,
# births and clones.
CURVES = json.loads((Path(__file__).parent / "healthy_losses.json").read_text())


def first_alarm(losses):
    return next((count for count in range(1, len(losses) + 1) if explosion(losses[:count])), None)


@pytest.mark.parametrize("name", CURVES)
def test_healthy_trainings_raise_no_alarm(name):
    assert first_alarm(CURVES[name]) is None


@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize("part", [0.1, 0.3, 0.9])
def test_an_explosion_is_noticed_at_once(name, part):
    losses = CURVES[name]
    start = max(USUAL_LINES, int(part * len(losses)))
    exploded = losses[:start] + [2 * EXPLOSION_FACTOR * max(losses)] * 20
    assert first_alarm(exploded) == start + EXPLODED_LINES
    creeping = losses[:start] + [losses[start - 1] * 1.2**step for step in range(30)]
    assert first_alarm(creeping)


def test_a_few_bad_views_are_no_explosion():
    assert first_alarm([1.0] * 50 + [1000.0] * (EXPLODED_LINES - 1) + [1.0] * 50) is None


def test_the_growth_factor_is_returned():
    assert explosion([1.0] * 20 + [5.0, 6.0, 7.0]) == 5
