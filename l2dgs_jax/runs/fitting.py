"""Training a scene from a data set, in memory."""

import dataclasses
from collections.abc import Callable

from l2dgs_jax.config import Config
from l2dgs_jax.data import Dataset
from l2dgs_jax.runs.checkpoints import Checkpoint
from l2dgs_jax.runs.divergence import with_lower_rates
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runtime import devices
from l2dgs_jax.training import Member, Progress, engine, initial_state, resolve


def fit(
    dataset: Dataset,
    config: Config,
    on_step: Callable[[Progress], None] | None = None,
    *,
    start: Checkpoint | None = None,
    device_count: int | None = None,
) -> Run:
    """Train a scene, coarse stage then fine. Nothing is written to disk; `save_run` does that.

    If jax has not started yet, every CPU core becomes a device, as in the command lines.

    Args:
        dataset: frames and cameras, as `load_dataset` returns them. Its source overrides the settings of how a scene is
            read (`Source.settings`).
        config: all other settings, such as one of `PRESETS`.
        on_step: called after every step; its argument is valid until it returns.
        start: checkpoint to continue from; if not given, training starts from the beginning.
        device_count: number of devices to spread the views of a step over; if not given, as many as get equal shares.

    Raises:
        DivergedError: the loss or a gradient is not finite.
        UserError: a setting is out of range, or the data set cannot be trained on.
        ValueError: the views cannot be shared evenly by so many devices, there are not that many, or a process would be
            left without any.
    """
    config.check()
    devices.one_per_core()
    if device_count is None:
        device_count = devices.shares(config.batch_size)
    if device_count < 1 or config.batch_size % device_count:
        raise ValueError(f"device_count is {device_count}; expected a divisor of the batch size, {config.batch_size}")
    mesh = devices.mesh(views=device_count)
    if dataset.source:
        config = dataclasses.replace(config, **dataset.source.settings)
    config = resolve(config, dataset)
    start = start or Checkpoint(initial_state(dataset, config))
    state = start.state
    member = Member(dataset.train, with_lower_rates(config, start.halvings), state)
    for progress in engine.run([member], start.pair_capacity, mesh):
        if on_step:
            on_step(progress)
        state = progress.states
    return Run(config, dataset, state if state is member.state else devices.member(state, 0))
