"""What a training leaves in its run folder while it runs: metrics and checkpoints."""

import json
import time
from pathlib import Path

from l2dgs_jax.config import Config
from l2dgs_jax.runs import checkpoints
from l2dgs_jax.runs.checkpoints import Checkpoint
from l2dgs_jax.runs.folder import CHECKPOINT, COARSE, METRICS
from l2dgs_jax.runtime import devices
from l2dgs_jax.training import Progress

LOG_EVERY = 10  # steps between lines of the metrics file


class Recorder:
    """Records one member of a training in its run folder."""

    def __init__(self, folder: Path, config: Config, done: int):
        """Drop metrics after the step `done`, from a run that was interrupted after its last checkpoint.

        Args:
            folder: of the run, which exists.
            config: its settings, what they left to the data filled in.
            done: number of steps already taken.
        """
        self.folder, self.config, self.begun = folder, config, time.monotonic()
        metrics = folder / METRICS
        kept = [line for line in metrics.read_text().splitlines() if json.loads(line)["step"] <= done] if done else []
        metrics.write_text("".join(f"{line}\n" for line in kept))

    def __call__(self, progress: Progress, member: int = 0) -> dict | None:
        """Write what is due after a step.

        Args:
            progress: as `engine.run` yields it.
            member: which of its members.

        Returns:
            The line of metrics, if one was due.
        """
        step, config = progress.step, self.config
        last = step == config.steps
        if step == config.coarse_steps:
            self.save(progress, member, COARSE)
        if step % config.checkpoint_every == 0 or last:
            self.save(progress, member, CHECKPOINT)
        if step % LOG_EVERY and not last:
            return None
        report = devices.member(progress.report, member)
        alive = devices.member(progress.states.scene.alive, member)
        values = {"loss": report.loss, "psnr": report.psnr, **report.terms}
        line = {
            "step": step,
            "stage": "coarse" if step <= config.coarse_steps else "fine",
            "gaussians": int(alive.sum()),
            "pairs": int(report.pairs),
            **{name: round(float(value), 6) for name, value in values.items()},
            "seconds": round(time.monotonic() - self.begun, 2),
        }
        with open(self.folder / METRICS, "a") as file:
            file.write(json.dumps(line) + "\n")
        return line

    def save(self, progress: Progress, member: int, name: str) -> None:
        """Write the member's state to the file of that name in the run folder."""
        state = devices.member(progress.states, member)
        checkpoints.save(self.folder / name, Checkpoint(state, progress.pair_capacity), self.config)
