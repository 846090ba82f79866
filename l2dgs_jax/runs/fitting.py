"""From a data set to a trained scene, in memory."""

from collections.abc import Callable

from l2dgs_jax.config import Config
from l2dgs_jax.data import Dataset
from l2dgs_jax.runs.checkpoints import Checkpoint
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
    """Train a scene, coarse stage then fine. Nothing is written to disk.

    Args:
        dataset: what was filmed, as `load_dataset` returns it.
        config: settings, such as one of `PRESETS`. Those of how a scene is read (`downscale`, `format`, `held_out`,
            `frame_memory`) have had their say in `load_dataset` and are ignored.
        on_step: called after every step; its argument is valid until it returns. A `runs.Recorder` leaves metrics and
            checkpoints in a folder.
        start: a state to go on from; a fresh one if not given.
        device_count: how many devices the views of a step are spread over; as many as share them evenly if not given.

    Raises:
        DivergedError: the loss or a gradient is not finite.
        UserError: the numbers of steps make no training.
        ValueError: there are not that many devices.
    """
    config.check_steps()
    devices.one_per_core()
    config = resolve(config, dataset.train)
    mesh = devices.mesh(views=device_count or devices.shares(config.batch_size))
    state, pair_capacity = start or (initial_state(dataset, config), None)
    member = Member(dataset.train, config, state)
    for progress in engine.run([member], pair_capacity, mesh):
        if on_step:
            on_step(progress)
        state = progress.states
    return Run(config, dataset, devices.member(state, 0) if state is not member.state else state)
