"""Training that is recorded in a run folder, so that it survives interruptions and divergence."""

from collections.abc import Callable
from pathlib import Path

import jax

from l2dgs_jax.config import Config
from l2dgs_jax.data import Dataset
from l2dgs_jax.errors import DIVERGED, Interrupted, UserError
from l2dgs_jax.runs import checkpoints, previews
from l2dgs_jax.runs.checkpoints import Checkpoint
from l2dgs_jax.runs.displays import Display
from l2dgs_jax.runs.divergence import EXPLODED_LINES, MAX_HALVINGS, explosion, halve_rates, rate_factor, standing
from l2dgs_jax.runs.fitting import fit
from l2dgs_jax.runs.folder import CHECKPOINT, read_metrics
from l2dgs_jax.runs.pace import Pace
from l2dgs_jax.runs.recorder import Recorder
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runtime import devices
from l2dgs_jax.runtime.memory import memory_errors
from l2dgs_jax.training import DivergedError, Progress

LESS_MEMORY = (
    "enough: a larger --downscale, or a smaller --batch-size, --density.max-gaussians or --frame-memory, needs less"
)


def fit_in_folder(
    folder: Path,
    dataset: Dataset,
    config: Config,
    start: Checkpoint,
    display: Display,
    stopping: Callable[[], int | None],
    device_count: int | None = None,
    with_previews: bool = False,
    watch: Callable[[Progress], None] | None = None,
) -> Run:
    """`fit`, recorded so that it can be resumed; if training diverges, it goes back and continues with lower rates.

    Args:
        folder: of the run, with its settings.
        dataset: its scene.
        config: its settings, resolved by `training.resolve`.
        start: checkpoint to continue from.
        display: shows the progress.
        stopping: called after every step; returns the signal that asks to stop, or None.
        device_count: see `fit`.
        with_previews: whether to write pictures of two views from time to time.
        watch: called after every step.

    Raises:
        Interrupted: a signal has stopped the training; its last step is in a checkpoint.
        UserError: the disk is full or the folder not writable, the memory does not suffice, or lower rates do not help.
    """
    while True:
        try:
            return _fit(folder, dataset, config, start, display, stopping, device_count, with_previews, watch)
        except DivergedError as error:
            if start.halvings == MAX_HALVINGS or jax.process_count() > 1:
                raise UserError(
                    f"{folder}: {error}; expected a loss that falls: train anew with lower learning rates", DIVERGED
                ) from None
            reason = str(error)
        halve_rates(folder, start.halvings + 1)
        start = standing(folder, dataset, config)
        back, factor = int(start.state.step), rate_factor(start.halvings)
        message = f"{reason}: going back to step {back}, with learning rates times {factor:g}"
        display("diverged", message=message, step=back, rate_factor=factor)


def _fit(
    folder: Path,
    dataset: Dataset,
    config: Config,
    start: Checkpoint,
    display: Display,
    stopping: Callable[[], int | None],
    device_count: int | None,
    with_previews: bool,
    watch: Callable[[Progress], None] | None,
) -> Run:
    done = int(start.state.step)
    record = Recorder(folder, config, done, start.halvings)
    previews.drop_after(folder, done)
    drawn_at = previews.moments(config) if with_previews else frozenset()
    lines = read_metrics(folder)
    pace = Pace(config, done, int(start.state.scene.alive.sum()))

    def on_step(progress: Progress) -> None:
        line = record(progress)
        display("step", step=record.step, stage=config.stage_of(record.step), left=pace(record.step))
        if line:
            display("metrics", **line)
            lines.append(line)
            grown = explosion([line["loss"] for line in lines])
            if grown and jax.process_count() == 1:
                # Going back to a checkpoint of the exploded state would make lower rates useless.
                checkpoints.drop_after(folder / CHECKPOINT, lines[-1 - EXPLODED_LINES]["step"])
                raise DivergedError(f"by step {record.step} the loss has grown {grown:.0f}-fold", progress)
        if record.step in drawn_at:
            files = previews.draw(folder, dataset, config, devices.member(progress.states, 0))
            display("previews", step=record.step, files=[str(file.relative_to(folder)) for file in files])
        if watch:
            watch(progress)
        if record.step == config.coarse_steps < config.steps:
            display("compiling", stage="fine")
        signal_number = stopping()
        if signal_number:
            record.checkpoint(progress)
            raise Interrupted(f"stopped after step {record.step} of {config.steps}", 128 + signal_number)

    display("begin", step=done, steps=config.steps)
    if done < config.steps:
        display("compiling", stage=config.stage_of(done + 1))
    with memory_errors(lambda: f"after step {record.step} of {config.steps}", LESS_MEMORY):
        return fit(dataset, config, on_step, start=start, device_count=device_count)
