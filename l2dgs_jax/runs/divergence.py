"""What is done about a training that diverges: it goes on from a checkpoint, with lower learning rates."""

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

HALVINGS = 3  # of the learning rates, after which a training is given up
RATES = "rates.json"  # how often those of a run folder were halved, if they were

# A loss has exploded if SUSTAINED lines of metrics in a row are EXPLOSION times the lowest median of STEADY in a row
# before them. In 79 trainings that went well, births and starts of stages included, the most was 1.7 times.
EXPLOSION, SUSTAINED, STEADY = 4.0, 3, 5

_RATES = [f"optim.{field.name}" for field in dataclasses.fields(OptimConfig) if "_lr" in field.name]


def rate_factor(halvings: int) -> float:
    """What the learning rates of the settings are multiplied by."""
    return 0.5**halvings


def with_lower_rates(config: Config, halvings: int) -> Config:
    """The settings with all learning rates halved so often."""
    rates = {name: overrides.read(config, name) * rate_factor(halvings) for name in _RATES}
    return overrides.replace(config, rates)


def explosion(losses: Sequence[float]) -> float | None:
    """What multiple of its usual value the loss has come to, if it has exploded.

    Args:
        losses: of the lines of metrics so far.
    """
    before, last = losses[:-SUSTAINED], losses[-SUSTAINED:]
    if len(before) < STEADY:
        return None
    usual = np.median(np.lib.stride_tricks.sliding_window_view(before, STEADY), axis=1).min()
    usual = max(usual, 1e-6)  # the last digit of a line
    return float(min(last) / usual) if min(last) > EXPLOSION * usual else None


def standing(folder: Path, dataset: Dataset, config: Config) -> Checkpoint:
    """Where the training of a run folder goes on, also if it has diverged since its last checkpoint.

    It then goes on from that checkpoint with its rates halved. If it diverges once more before it has written another,
    the harm may have been done before: it goes back to the checkpoint before that one, and so on.

    Args:
        folder: of the run.
        dataset: its scene.
        config: its settings, what they left to the data filled in.

    Raises:
        UserError: no checkpoint is whole, or a file is of other settings or unreadable.
    """
    halvings, last = _halvings(folder), last_checkpoint(folder, dataset, config)
    in_vain = halvings - last.halvings
    if in_vain <= 0:
        return last
    back = last_checkpoint(folder, dataset, config, skip=in_vain - 1)
    factor = rate_factor(halvings - back.halvings)
    schedules = {
        name: rate._replace(start=rate.start * factor, end=rate.end * factor)
        for name, rate in back.state.adam.schedules.items()
    }
    adam = back.state.adam._replace(schedules=schedules)
    return Checkpoint(back.state._replace(adam=adam), back.pair_capacity, halvings)


def halve_rates(folder: Path, halvings: int) -> None:
    """Note in a run folder that its learning rates are to be halved so often.

    Raises:
        UserError: it cannot be written.
    """
    write_json(folder / RATES, {"halvings": halvings})


def _halvings(folder: Path) -> int:
    path = folder / RATES
    if not path.exists():
        return 0
    try:
        return int(json.loads(path.read_text())["halvings"])
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(f"{path}: unreadable; expected what train wrote, or no such file") from None
