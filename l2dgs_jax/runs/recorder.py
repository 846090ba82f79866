"""Recording a training in its run folder: metrics and checkpoints."""

import time
from pathlib import Path
from typing import Any

import jax

from l2dgs_jax.config import Config
from l2dgs_jax.runs import checkpoints
from l2dgs_jax.runs.checkpoints import Checkpoint
from l2dgs_jax.runs.divergence import rate_factor
from l2dgs_jax.runs.folder import CHECKPOINT, COARSE, METRICS, read_metrics
from l2dgs_jax.runtime import devices
from l2dgs_jax.runtime.files import append_line, as_json, replacing
from l2dgs_jax.runtime.memory import memory_in_use
from l2dgs_jax.training import Progress
from l2dgs_jax.training.optimizer import learning_rates
from l2dgs_jax.training.step import cooldown

LOG_EVERY = 10  # steps between lines of the metrics file

# Fields of a line of metrics; all others are terms of the loss.
_FACTS = ("step", "stage", "gaussians", "pairs", "loss", "psnr", "rate_factor", "rates", "memory", "seconds")


def terms(line: dict[str, Any]) -> dict[str, float]:
    """The terms of the loss in a line of metrics."""
    return {name: value for name, value in line.items() if name not in _FACTS}


class Recorder:
    """Records one member of a training in its run folder.

    Attributes:
        step: the last step that it was called for.
    """

    def __init__(self, folder: Path, config: Config, done: int, halvings: int = 0):
        """Remove the metrics of steps after `done`, which a run that was interrupted after a checkpoint may have.

        Args:
            folder: of the run, which exists.
            config: its settings, resolved by `training.resolve`.
            done: number of steps already taken.
            halvings: see `Checkpoint`.
        """
        self.folder, self.config, self.halvings, self.begun = folder, config, halvings, time.monotonic()
        self.step = self._saved = done
        kept = [as_json(line) for line in read_metrics(folder) if line["step"] <= done]
        with replacing(folder / METRICS) as temporary:
            temporary.write_text("".join(f"{line}\n" for line in kept))

    def __call__(self, progress: Progress, member: int = 0) -> dict | None:
        """Write metrics and checkpoints that are due after a step.

        Args:
            progress: as `engine.run` yields it.
            member: index of the member.

        Returns:
            The line of metrics, if one was due.

        Raises:
            UserError: a file cannot be written.
        """
        self.step, config = progress.step, self.config
        last = self.step == config.steps
        # Metrics first: those after the last checkpoint are removed when the run resumes from it.
        line = self._line(progress, member) if self.step % LOG_EVERY == 0 or last else None
        if line:
            append_line(self.folder / METRICS, as_json(line))
        if self.step == config.coarse_steps:
            self._save(progress, member, COARSE, 1)
        if self.step % config.checkpoint_every == 0 or last:
            self.checkpoint(progress, member)
        return line

    def checkpoint(self, progress: Progress, member: int = 0) -> None:
        """Write a checkpoint, unless this step's was already written."""
        if progress.step != self._saved:
            self._save(progress, member, CHECKPOINT, self.config.keep_checkpoints)
            self._saved = progress.step

    def _save(self, progress: Progress, member: int, name: str, keep: int) -> None:
        checkpoint = Checkpoint(devices.member(progress.states, member), progress.pair_capacity, self.halvings)
        checkpoints.save(self.folder / name, checkpoint, self.config, keep)

    def _line(self, progress: Progress, member: int) -> dict:
        report = devices.member(progress.report, member)
        alive = devices.member(progress.states.scene.alive, member)
        adam = progress.states.adam
        rates = jax.device_get(learning_rates(*devices.member((adam.schedules, adam.step), member)))
        factor = cooldown(progress.step, self.config)
        values = {"loss": report.loss, "psnr": report.psnr, **report.terms}
        memory = memory_in_use()
        return {
            "step": progress.step,
            "stage": self.config.stage_of(progress.step),
            "gaussians": int(alive.sum()),
            "pairs": int(report.pairs),
            **{name: round(float(value), 6) for name, value in values.items()},
            "rate_factor": rate_factor(self.halvings),
            "rates": {name: float(f"{float(factor * rate):.3g}") for name, rate in rates.items()},
            "memory": None if memory is None else round(memory / 2**30, 3),
            "seconds": round(time.monotonic() - self.begun, 2),
        }
