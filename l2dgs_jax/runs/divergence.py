"""Handling of trainings that diverge: they continue from a checkpoint with lower learning rates."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from l2dgs_jax.config import Config, OptimConfig, overrides
from l2dgs_jax.data import Dataset
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs.checkpoints import Checkpoint
from l2dgs_jax.runs.folder import last_checkpoint
from l2dgs_jax.runtime.files import write_json

MAX_HALVINGS = 3  # of the learning rates; then a training is given up
RATES_FILE = "rates.json"  # in the run folder: how often the learning rates were halved, if ever

# A loss has exploded if it exceeds EXPLOSION_FACTOR times its usual value in EXPLODED_LINES lines of metrics in a row.
# The usual value is the lowest median of USUAL_LINES lines in a row before them. In 79 trainings that went well, the
# largest factor was 1.7, including steps after new Gaussians were added and starts of stages.
EXPLOSION_FACTOR, EXPLODED_LINES, USUAL_LINES = 4.0, 3, 5

_RATES = [f"optim.{field.name}" for field in dataclasses.fields(OptimConfig) if "_lr" in field.name]


def rate_factor(halvings: int) -> float:
    """The factor on all learning rates after so many halvings."""
    return 0.5**halvings


def with_lower_rates(config: Config, halvings: int) -> Config:
    """The settings with all learning rates halved `halvings` times."""
    rates = {name: overrides.read(config, name) * rate_factor(halvings) for name in _RATES}
    return overrides.replace(config, rates)


def explosion(losses: Sequence[float]) -> float | None:
    """The loss as a multiple of its usual value, if it has exploded; otherwise None.

    Args:
        losses: of the lines of metrics so far.
    """
    before, last = losses[:-EXPLODED_LINES], losses[-EXPLODED_LINES:]
    if len(before) < USUAL_LINES:
        return None
    usual = np.median(np.lib.stride_tricks.sliding_window_view(before, USUAL_LINES), axis=1).min()
    usual = max(usual, 1e-6)  # metrics are rounded to this
    return float(min(last) / usual) if min(last) > EXPLOSION_FACTOR * usual else None


def standing(folder: Path, dataset: Dataset, config: Config) -> Checkpoint:
    """Where the training of a run folder continues, also if it has diverged since its last checkpoint.

    If it has, it continues from that checkpoint with halved learning rates. If it diverges again before it writes
    another checkpoint, that one may have been harmed already: the training goes back to the one before, and so on.

    Args:
        folder: of the run.
        dataset: its scene.
        config: its settings, resolved by `training.resolve`.

    Raises:
        UserError: all checkpoints are damaged, or a file has other settings or is unreadable.
    """
    halvings, last = _halvings(folder), last_checkpoint(folder, dataset, config)
    since_last = halvings - last.halvings
    if since_last <= 0:
        return last
    back = last_checkpoint(folder, dataset, config, skip=since_last - 1)
    factor = rate_factor(halvings - back.halvings)
    schedules = {
        name: rate._replace(start=rate.start * factor, end=rate.end * factor)
        for name, rate in back.state.adam.schedules.items()
    }
    adam = back.state.adam._replace(schedules=schedules)
    return Checkpoint(back.state._replace(adam=adam), back.pair_capacity, halvings)


def halve_rates(folder: Path, halvings: int) -> None:
    """Record in a run folder that its learning rates are to be halved `halvings` times.

    Raises:
        UserError: it cannot be written.
    """
    write_json(folder / RATES_FILE, {"halvings": halvings})


def _halvings(folder: Path) -> int:
    path = folder / RATES_FILE
    if not path.exists():
        return 0
    try:
        return int(json.loads(path.read_text())["halvings"])
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(f"{path}: unreadable; expected what train wrote, or no such file") from None
