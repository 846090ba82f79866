"""Training, scoring and tabulating all members of a study."""

import contextlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax
from jax.sharding import Mesh
from tqdm import tqdm

from l2dgs_jax import runs
from l2dgs_jax.config import to_dict
from l2dgs_jax.data.images import write_image
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs import Recorder, Run
from l2dgs_jax.runs.advice import misfit
from l2dgs_jax.runs.scores import evaluate
from l2dgs_jax.runtime import devices, distributed
from l2dgs_jax.runtime.files import is_taken, make_folder, write_json
from l2dgs_jax.runtime.locks import LOCK, locked
from l2dgs_jax.runtime.memory import memory_errors
from l2dgs_jax.study import report
from l2dgs_jax.study.grouping import Trial, load_groups
from l2dgs_jax.study.spec import Spec
from l2dgs_jax.training import DivergedError, Member, Progress, engine
from l2dgs_jax.visualize import contact_sheet

PLANS_FILE = "study.json"  # in the study's folder: its members
LESS_MEMORY = "fewer --devices, or members of a larger downscale or a smaller batch_size or density.max_gaussians"
DIVERGED_FILE = "diverged.json"  # in the folder of a member that has diverged and is frozen


def run_study(spec: Spec, output: Path, *, resume: bool = False, device_count: int | None = None) -> list[str]:
    """Train, score and tabulate all members of a study, together with the other processes if there are any.

    Args:
        spec: from `study.spec.read`.
        output: the study's folder.
        resume: whether to continue the study in the folder.
        device_count: number of devices to spread the members of a group over, at most one per member; None for all.

    Returns:
        Names of the files in `output` that compare the members.

    Raises:
        UserError: a scene cannot be read, the folder holds another study or cannot be written, or there are too few
            devices or members; or another process works in the folder, or memory does not suffice.
    """
    described = [{"name": p.name, "scene": p.scene, "settings": to_dict(p.config)} for p in spec.plans]
    _check_folder(output, described, resume)
    first, reached = jax.process_index() == 0, "before the first step"
    with contextlib.ExitStack() as stack, memory_errors(lambda: reached, LESS_MEMORY):
        if first and resume:
            stack.enter_context(locked(output))
        groups = load_groups(spec)
        meshes = [_mesh(group, device_count or jax.device_count()) for group in groups]
        distributed.barrier("all scenes are read")
        if first and not resume:  # only now, as a study that cannot start should leave no folder
            make_folder(output)
            stack.enter_context(locked(output))
            _check_folder(output, described, resume)  # another study may have begun there meanwhile
            write_json(output / PLANS_FILE, described)
        if first:
            _print_notes(groups)
        for index, (group, mesh) in enumerate(zip(groups, meshes, strict=True)):
            reached = f"in group {index + 1} of {len(groups)}"
            if first:
                size, count = f"{group[0].dataset.width}x{group[0].dataset.height}", mesh.size if mesh else 1
                print(f"group {index + 1} of {len(groups)}: {len(group)} members at {size}, devices: {count}")
            _train(group, output, mesh)
            distributed.barrier("the group is trained")
            for trial in group[jax.process_index() :: jax.process_count()]:
                _score(trial, output)
        distributed.barrier("all members are scored")
        return report.write(output, [plan.name for plan in spec.plans]) if first else []


def _print_notes(groups: Sequence[Sequence[Trial]]) -> None:
    """What readers assumed about the scenes, and where these do not fit the settings, each once."""
    trials = [trial for group in groups for trial in group]
    notes = [f"note: {note}" for trial in trials for note in trial.dataset.notes]
    warnings = [(trial, misfit(trial.dataset, trial.config)) for trial in trials]
    notes += [f"warning: {trial.dataset.name}: {warning}" for trial, warning in warnings if warning]
    for note in dict.fromkeys(notes):
        print(note)


def _check_folder(output: Path, described: list[dict], resume: bool) -> None:
    """Check that the folder is free, or that it holds the study of these members."""
    if resume:
        try:
            held = json.loads((output / PLANS_FILE).read_text())
        except (OSError, ValueError):
            raise UserError(f"{output}: holds no study to resume; expected a folder that sweep wrote") from None
        if held != described:
            raise UserError(
                f"{output}: holds a study of other members or settings; expected the same command, or a new folder"
            )
    elif is_taken(output) and not (output.is_dir() and [path.name for path in output.iterdir()] == [LOCK]):
        raise UserError(f"{output}: already holds a study or files; expected a new folder, or --resume")


def _mesh(group: Sequence[Trial], device_count: int) -> Mesh | None:
    try:
        return devices.mesh(min(device_count, len(group)))
    except ValueError as error:
        names = f"{group[0].plan.name} and {len(group) - 1} members like it"
        raise UserError(f"{names}: {error}; expected fewer processes, or other --devices") from None


def _train(group: Sequence[Trial], output: Path, mesh: Mesh | None) -> None:
    """Train the members that are neither finished nor frozen, from their last checkpoints."""
    members: dict[str, Member] = {}
    pair_capacity: int | None = None
    for trial in group:
        folder, config = output / trial.plan.name, trial.config
        if (folder / DIVERGED_FILE).exists():
            continue
        state, needed, _ = runs.last_checkpoint(folder, trial.dataset, config)
        pair_capacity = max(needed or 0, pair_capacity or 0) or None
        if int(state.step) < config.steps:
            members[trial.plan.name] = Member(trial.dataset.train, config, state)
    distributed.barrier("all checkpoints are read")
    if not members:
        return
    if jax.process_index() == 0:
        for trial in group:
            runs.write_settings(output / trial.plan.name, trial.plan.scene, trial.config)
    distributed.barrier("all folders are made")
    followers: list[_Follower] | None = None
    try:
        for progress in _steps(list(members.values()), pair_capacity, mesh):
            if followers is None:
                own = [index for index in devices.own_rows(progress.states.step) if index < len(members)]
                followers = [_Follower(output / list(members)[i], list(members.values())[i], i) for i in own]
            for follower in followers:
                follower.follow(progress)
    finally:
        for follower in followers or ():
            follower.bar.close()


def _steps(members: Sequence[Member], pair_capacity: int | None, mesh: Mesh | None) -> Iterator[Progress]:
    """The steps of a training, including the one at which the last member diverges."""
    try:
        yield from engine.run(members, pair_capacity, mesh)
    except DivergedError as error:
        yield error.progress


class _Follower:
    """Records one member in its folder and shows its progress, until it diverges."""

    def __init__(self, folder: Path, member: Member, index: int):
        self.folder, self.index, self.done = folder, index, int(member.state.step)
        self.record = Recorder(folder, member.config, self.done)
        self.bar = tqdm(total=member.config.steps, initial=self.done, unit="step", desc=folder.name, dynamic_ncols=True)
        self.frozen = False

    def follow(self, progress: Progress) -> None:
        if self.frozen or progress.step <= self.done:
            return
        if int(devices.member(progress.states.step, self.index)) < progress.step:
            self.frozen = True
            self._freeze(progress)
            return
        self.bar.update()
        line = self.record(progress, self.index)
        if line:
            self.bar.set_postfix_str(f"{line['psnr']:.1f} dB, {line['gaussians']} Gaussians")

    def _freeze(self, progress: Progress) -> None:
        """Save the last state before the divergence, and the loss terms of the diverged step."""
        self.record.checkpoint(progress, self.index)
        terms = devices.member(progress.report.terms, self.index)
        found = {"step": progress.step - 1, "terms": {name: str(float(value)) for name, value in terms.items()}}
        write_json(self.folder / DIVERGED_FILE, found)
        self.bar.set_postfix_str(f"diverged at step {found['step']}, frozen")


def _score(trial: Trial, output: Path) -> None:
    """Score a trained member, unless it already was."""
    folder, config = output / trial.plan.name, trial.config
    path = folder / report.RESULT_FILE
    if path.exists():
        return
    state = runs.last_checkpoint(folder, trial.dataset, config).state
    run = Run(config, trial.dataset, state, folder)
    write_image(folder / runs.CONTACT_SHEET, contact_sheet(run))
    diverged = (folder / DIVERGED_FILE).exists()
    result = {
        "scene": trial.plan.scene,
        "variant": trial.plan.variant,
        "varied": trial.plan.varied,
        "ended": f"diverged at step {int(state.step)}" if diverged else report.FINISHED,
        "scores": evaluate(run),
    }
    write_json(path, result)
