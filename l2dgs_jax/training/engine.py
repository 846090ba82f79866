"""The coarse-to-fine loop over one scene or many at once. No input or output: callers consume what `run` yields."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Int, PyTree

from l2dgs_jax.config import Config, overrides
from l2dgs_jax.config.overrides import StaticConfig, combine
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.rasterizer import count_pairs
from l2dgs_jax.runtime import devices
from l2dgs_jax.runtime.capacity import next_capacity
from l2dgs_jax.runtime.devices import MEMBERS, VIEWS
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.training.batching import load_batch, next_batch
from l2dgs_jax.training.flows import neighbour_flows
from l2dgs_jax.training.state import Batch, StepReport, TrainState, with_capacity
from l2dgs_jax.training.step import begin_stage, densify, train_step, tree_where
from l2dgs_jax.types import Scene

T = TypeVar("T")

MARGIN = 1.3  # size of the pair buffer over the pairs last needed: every new size costs a compilation


class Member(NamedTuple):
    """A scene in training: its views, its `resolve`d settings, and its state."""

    split: Split
    config: Config
    state: TrainState


class Progress(NamedTuple):
    """One finished step, as `run` yields it. `states` is valid until the next step is asked for.

    Attributes:
        step: number of finished steps; a member whose state has fewer has diverged and is frozen.
        states: of all members, stacked; `devices.member` takes one out.
        report: of all members, stacked.
        pair_capacity: size of the pair buffer of each member.
    """

    step: int
    states: TrainState
    report: StepReport
    pair_capacity: int


class DivergedError(ArithmeticError):
    """No member can go on: the last of them was found to diverge at the step `progress`."""

    def __init__(self, message: str, progress: Progress):
        super().__init__(message)
        self.progress = progress


def run(members: Sequence[Member], pair_capacity: int | None = None, mesh: Mesh | None = None) -> Iterator[Progress]:
    """Train all members to the end, coarse stage then fine, by one program, yielding after every step.

    A member joins at the step that its state has reached. If its loss or gradient is not finite it stays as it was
    before that step, and the others go on.

    Args:
        members: their settings may differ in the numbers of `overrides.TRACED`, their states in the number of rows.
        pair_capacity: size of the pair buffer of a member to start with, as a checkpoint holds it.
        mesh: over which members and the views of a batch are spread (see `devices.mesh`); None for one device.

    Raises:
        DivergedError: no member is left.
    """
    config, start = members[0].config, min(int(member.state.step) for member in members)
    if start >= config.steps:
        return
    member_shards, view_shards = (mesh.shape[MEMBERS], mesh.shape[VIEWS]) if mesh else (1, 1)
    views = config.batch_size // view_shards
    pair_capacity = pair_capacity or max(first_capacity(m.split, m.state.scene, views) for m in members)
    # Every device needs equally many members; those added as padding wait for step -1, which never comes.
    padding = members[0]._replace(state=members[0].state._replace(step=jnp.asarray(-1, jnp.int32)))
    members = [*members, *[padding] * (-len(members) % member_shards)]
    states = devices.shard(_stack_states([member.state for member in members]), mesh, MEMBERS)
    static, columns = overrides.partition([member.config for member in members])
    values = devices.shard({name: _stack(column) for name, column in columns.items()}, mesh, MEMBERS)

    splits = {id(member.split): member.split for member in members}
    flows = {key: neighbour_flows(split, filled=True) if config.inbetweens else None for key, split in splits.items()}
    steps = range(start, config.steps)
    read = prefetch(
        lambda step: _stack([next_batch(m.split, m.config, step, flows[id(m.split)]) for m in members]), steps
    )
    with contextlib.closing(read):  # its threads read the next batches while a step is computed
        for step, batches in zip(steps, read, strict=True):
            moving = step >= config.coarse_steps
            stage_start = config.coarse_steps if moving else 0
            if moving and step == stage_start:
                states = begin_fine_stage(states, values, step, config=static, mesh=mesh)

            batches = devices.shard(batches, mesh, MEMBERS, VIEWS)
            take = partial(train_steps, config=static, moving=moving, mesh=mesh)
            states, report, tally = take(states, batches, values, step, pair_capacity=pair_capacity)
            while tally.pairs > pair_capacity:
                pair_capacity = next_capacity(MARGIN * float(tally.pairs))
                states, again, tally = take(states, batches, values, step, pair_capacity=pair_capacity)
                report = jax.tree.map(partial(jnp.where, report.overflow), again, report)
            if not tally.left:
                raise DivergedError(_complaint(report, step), Progress(step + 1, states, report, pair_capacity))

            stage_step = step + 1 - stage_start
            left = growths_left(stage_step, moving, config)
            if left:
                states = densify_all(states, values, step + 1, left, config=static, mesh=mesh)
            yield Progress(step + 1, states, report, pair_capacity)


class Tally(NamedTuple):
    """What all processes must agree on after a step.

    Attributes:
        pairs: the largest number of pairs that a member needs, among those that were to take the step.
        left: number of members that have taken it or are past it.
    """

    pairs: Int[Array, ""]
    left: Int[Array, ""]


@partial(jax.jit, static_argnames=("config", "moving", "pair_capacity", "mesh"), donate_argnums=0)
def train_steps(
    states: TrainState,
    batches: Batch,
    values: dict[str, Any],
    step: Int[Array, ""] | int,
    *,
    config: StaticConfig,
    moving: bool,
    pair_capacity: int,
    mesh: Mesh | None = None,
) -> tuple[TrainState, StepReport, Tally]:
    """`train_step` number `step` of every member that has come that far.

    Args:
        states: of the members, stacked.
        batches: likewise.
        values: the settings in which members differ, by dotted name, stacked.
        step: its number.
        config: all other settings, with placeholders for those.
        moving: whether it is a step of the fine stage.
        pair_capacity: size of each member's pair buffer.
        mesh: see `run`.
    """

    def take(
        step: Int[Array, ""] | int, state: TrainState, values: dict[str, Any], batch: Batch
    ) -> tuple[TrainState, StepReport]:
        own = combine(config, values)
        axis = VIEWS if mesh else None
        return train_step(state, batch, own, moving=moving, pair_capacity=pair_capacity, at=step, axis=axis)

    after, report = _each_member(take, mesh, step, states, values, batches)
    pairs = jnp.where(states.step == step, report.pairs, 0).max()
    return after, report, Tally(pairs, (after.step > step).sum())


@partial(jax.jit, static_argnames=("config", "mesh"))
def begin_fine_stage(
    states: TrainState, values: dict[str, Any], step: Int[Array, ""] | int, *, config: StaticConfig, mesh: Mesh | None
) -> TrainState:
    """`begin_stage` for every member that has come to that step."""

    def begin(step: Int[Array, ""] | int, state: TrainState, values: dict[str, Any]) -> TrainState:
        own = combine(config, values)
        fresh = begin_stage(state.scene, state.step, own, own.fine_steps)
        return tree_where(state.step == step, fresh, state)

    return _each_member(begin, mesh, step, states, values)


def densify_all(
    states: TrainState, values: dict[str, Any], step: int, growths: int, *, config: StaticConfig, mesh: Mesh | None
) -> TrainState:
    """`densify` for every member that has come to that step; if one runs out of rows, the capacity of all grows."""
    while True:
        grown, rows = _densify_all(states, values, step, growths, config=config, mesh=mesh)
        if not rows:
            return grown
        states = _with_capacity(states, next_capacity(int(rows)))


@partial(jax.jit, static_argnames=("config", "mesh"))
def _densify_all(
    states: TrainState,
    values: dict[str, Any],
    step: Int[Array, ""] | int,
    growths: Int[Array, ""] | int,
    *,
    config: StaticConfig,
    mesh: Mesh | None,
) -> tuple[TrainState, Int[Array, ""]]:
    def grow(
        now: tuple[Int[Array, ""] | int, Int[Array, ""] | int], state: TrainState, values: dict[str, Any]
    ) -> tuple[TrainState, Int[Array, ""]]:
        step, growths = now
        grown, rows = densify(state, combine(config, values), growths)
        due = state.step == step
        return tree_where(due, grown, state), jnp.where(due, rows, 0)

    grown, rows = _each_member(grow, mesh, (step, growths), states, values)
    return grown, rows.max()


_with_capacity = partial(jax.jit, static_argnums=1)(jax.vmap(with_capacity, (0, None)))


def _each_member(function: Callable, mesh: Mesh | None, common: PyTree, *trees: PyTree) -> Any:
    """`function(common, *rows)` for the rows of every member in the trees."""
    platform = (mesh.devices.flat[0] if mesh else jax.devices()[0]).platform

    def here(common: PyTree, *trees: PyTree) -> Any:
        """For the members that this device holds."""
        each = partial(function, common)
        if len(jax.tree.leaves(trees)[0]) == 1:
            return jax.tree.map(lambda x: x[None], each(*jax.tree.map(lambda x: x.squeeze(0), trees)))
        if platform == "cpu":
            # One member keeps all cores busy; batched by vmap they miss the caches and take 1.4 times as long.
            return jax.lax.map(lambda rows: each(*rows), trees)
        return jax.vmap(each)(*trees)

    if mesh is None:
        return here(common, *trees)
    specs = (P(), P(MEMBERS), P(MEMBERS), P(MEMBERS, VIEWS))[: 1 + len(trees)]
    return jax.shard_map(here, mesh=mesh, in_specs=specs, out_specs=P(MEMBERS), check_vma=False)(common, *trees)


def _stack(trees: Sequence[T]) -> T:
    """Host arrays stacked; a single one is not copied."""
    return jax.tree.map(lambda *x: np.stack(x) if len(x) > 1 else np.asarray(x[0])[None], *trees)


def _stack_states(states: Sequence[TrainState]) -> TrainState:
    """States stacked in new buffers, with as many rows and paths as the largest has."""
    capacity = max(len(state.scene.alive) for state in states)
    paths = max(0 if state.scene.params.paths is None else len(state.scene.params.paths) for state in states)
    return jax.tree.map(lambda *x: jnp.stack(x), *[with_capacity(state, capacity, paths) for state in states])


def _complaint(report: StepReport, step: int) -> str:
    """What this process's first member reports."""
    terms = {name: value.addressable_shards[0].data[0] for name, value in report.terms.items()}
    found = ", ".join(f"{name} {float(value):.3g}" for name, value in terms.items())
    return f"the loss or its gradient is not finite at step {step} ({found})"


def first_capacity(split: Split, scene: Scene, views: int) -> int:
    """Size of a pair buffer for the first views, with undeformed Gaussians, and a margin for the other views."""
    gaussians = scene.params.gaussians
    batch = load_batch(split, np.arange(views) % len(split.names))
    cameras = jax.tree.map(lambda x: jnp.asarray(x, gaussians.means.dtype), batch.cameras)
    height, width = split.images.shape[1:3]
    opacities = jnp.where(scene.alive, jax.nn.sigmoid(gaussians.logit_opacities), 0)
    rows = (gaussians.means, gaussians.quats, jnp.exp(gaussians.log_scales), opacities)
    per_view = (jnp.broadcast_to(x[None], (views, *x.shape)) for x in rows)
    return next_capacity(MARGIN * float(count_pairs(*per_view, cameras.viewmat, cameras.K, width, height)))


def growths_left(stage_step: int, moving: bool, config: Config) -> int:
    """How many densifications a stage has left from its step of that number on, if one follows this step; otherwise 0.

    None follows the last step of the run: what it adds could not be trained.
    """
    cfg = config.density
    is_last_stage = moving or not config.fine_steps
    last = min(cfg.stop - 1, (config.fine_steps if moving else config.coarse_steps) - is_last_stage)
    due = cfg.start < stage_step <= last and stage_step % cfg.interval == 0
    return (last - stage_step) // cfg.interval + 1 if due else 0
