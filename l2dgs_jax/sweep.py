"""`python -m l2dgs_jax.sweep SPEC.toml OUT`: a study of scenes, seeds and settings, trained together."""

import dataclasses
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import tyro
from jax.sharding import Mesh
from tqdm import tqdm

from l2dgs_jax import checkpoint, cli, devices, engine, hosts, runs, visualize
from l2dgs_jax.config import to_dict
from l2dgs_jax.data.images import write_image
from l2dgs_jax.engine import Member, Progress
from l2dgs_jax.errors import UserError
from l2dgs_jax.evaluate import evaluate
from l2dgs_jax.files import is_taken, make_folder, write_json
from l2dgs_jax.hosts import Hosts
from l2dgs_jax.recording import Recorder
from l2dgs_jax.runs import Run
from l2dgs_jax.study import report
from l2dgs_jax.study.grouping import Entrant, enter
from l2dgs_jax.study.spec import Plan, Spec, read

PLANS = "study.json"  # the members that OUT holds
DIVERGED = "diverged.json"  # in the folder of a member that is frozen


@dataclass(frozen=True)
class Sweep:
    """Train all members of a study, those whose shapes agree by one program, and compare them in one table.

    Attributes:
        spec: TOML file with scenes, seeds and settings; the README shows one.
        output: folder for the study: a run in a folder of its own for each member, results.json, .md and .png.
        resume: continue the study in the output folder from its last checkpoints.
        devices: how many devices the members are spread over, each core of a processor being one; all if not given.
        hosts: several processes.
    """

    spec: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    resume: bool = False
    devices: int | None = None
    hosts: Annotated[Hosts, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Hosts)


def main(arguments: Sequence[str]) -> None:
    """Sweep as the command line says."""
    devices.one_per_core()
    options = cli.parse(Sweep, arguments, "sweep")
    if options.devices is not None and options.devices < 1:
        raise UserError(f"--devices {options.devices}: expected at least one")
    with hosts.together(options.hosts):
        sweep(read(options.spec), options.output, resume=options.resume, device_count=options.devices)


def sweep(spec: Spec, output: Path, *, resume: bool = False, device_count: int | None = None) -> None:
    """Train, score and tabulate all members of a study; what `main` does once all processes have come together.

    Args:
        spec: of `study.spec.read`.
        output: the study's folder.
        resume: go on with what the folder holds.
        device_count: how many devices the members of a group are spread over, at most one each; None for all.

    Raises:
        UserError: a scene cannot be read, the folder holds another study or cannot be written, or there are too few
            devices or members.
    """
    _claim(output, spec.plans, resume)
    groups = enter(spec)
    meshes = [_mesh(group, device_count or jax.device_count()) for group in groups]
    hosts.meet("all scenes are read")
    for index, (group, mesh) in enumerate(zip(groups, meshes, strict=True)):
        if jax.process_index() == 0:
            size, count = f"{group[0].dataset.width}x{group[0].dataset.height}", mesh.size if mesh else 1
            print(f"group {index + 1} of {len(groups)}: {len(group)} members at {size}, devices: {count}")
        _train(group, output, mesh)
        hosts.meet("the group is trained")
        for entrant in group[jax.process_index() :: jax.process_count()]:
            _score(entrant, output)
    hosts.meet("all members are scored")
    if jax.process_index() == 0:
        names = report.write(output, [plan.name for plan in spec.plans])
        print((output / report.MARKDOWN).read_text())
        print(f"wrote {', '.join(str(output / name) for name in names)}")


def _claim(output: Path, plans: Sequence[Plan], resume: bool) -> None:
    """Write what the folder is for, or compare it with what it was for."""
    described = [{"name": p.name, "scene": p.scene, "settings": to_dict(p.config)} for p in plans]
    path = output / PLANS
    if resume:
        try:
            held = json.loads(path.read_text())
        except (OSError, ValueError):
            raise UserError(f"{output}: holds no study to resume; expected a folder that sweep wrote") from None
        if held != described:
            raise UserError(f"{output}: holds a study of other members or settings; expected the same file again")
    elif is_taken(output):
        raise UserError(f"{output}: already holds a study or files; expected a new folder, or --resume")
    hosts.meet("the folder is looked at")
    if jax.process_index() == 0 and not resume:
        make_folder(output)
        write_json(path, described)


def _mesh(group: Sequence[Entrant], device_count: int) -> Mesh | None:
    try:
        return devices.mesh(min(device_count, len(group)))
    except ValueError as error:
        names = f"{group[0].plan.name} and {len(group) - 1} members like it"
        raise UserError(f"{names}: {error}; expected fewer processes, or other --devices") from None


def _train(group: Sequence[Entrant], output: Path, mesh: Mesh | None) -> None:
    """Train what is neither finished nor frozen, from where it stands."""
    members: dict[str, Member] = {}
    pair_capacity = None
    for entrant in group:
        folder, config = output / entrant.plan.name, entrant.config
        if (folder / DIVERGED).exists():
            continue
        state = engine.initial_state(entrant.dataset, config)
        if (folder / runs.CHECKPOINT).exists():
            state, needed = checkpoint.load(folder / runs.CHECKPOINT, config, state)
            pair_capacity = max(needed, pair_capacity or 0)
        if int(state.step) < config.steps:
            members[entrant.plan.name] = Member(entrant.dataset.train, config, state)
    hosts.meet("all checkpoints are read")
    if not members:
        return
    if jax.process_index() == 0:
        for entrant in group:
            runs.write_settings(output / entrant.plan.name, entrant.plan.scene, entrant.config)
    hosts.meet("all folders are made")
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
    """The steps of a training, also the one after which no member is left."""
    try:
        yield from engine.run(members, pair_capacity, mesh)
    except engine.DivergedError as error:
        yield error.progress


class _Follower:
    """Records one member in its folder and shows how it goes, until it diverges."""

    def __init__(self, folder: Path, member: Member, index: int):
        self.folder, self.index, self.done = folder, index, int(member.state.step)
        self.record = Recorder(folder, member.config, self.done)
        self.bar = tqdm(total=member.config.steps, initial=self.done, unit="step", desc=folder.name, dynamic_ncols=True)
        self.frozen = False

    def follow(self, progress: Progress) -> None:
        if self.frozen or progress.step <= self.done:
            return
        if int(devices.row(progress.states.step, self.index)) < progress.step:
            self.frozen = True
            self._freeze(progress)
            return
        self.bar.update()
        line = self.record(progress, self.index)
        if line:
            self.bar.set_postfix_str(f"{line['psnr']:.1f} dB, {line['gaussians']} Gaussians")

    def _freeze(self, progress: Progress) -> None:
        """Keep the last state that could be trusted, and say what was found after it."""
        self.record.save(progress, self.index, runs.CHECKPOINT)
        terms = devices.row(progress.report.terms, self.index)
        found = {"step": progress.step - 1, "terms": {name: str(float(value)) for name, value in terms.items()}}
        write_json(self.folder / DIVERGED, found)
        self.bar.set_postfix_str(f"diverged at step {found['step']}, frozen")


def _score(entrant: Entrant, output: Path) -> None:
    """Score a trained member, unless that was done before the study was interrupted."""
    folder, config = output / entrant.plan.name, entrant.config
    path = folder / report.RESULT
    if path.exists():
        return
    state = checkpoint.load(folder / runs.CHECKPOINT, config, engine.initial_state(entrant.dataset, config)).state
    run = Run(folder, config, entrant.dataset, state)
    write_image(folder / runs.CONTACT_SHEET, visualize.contact_sheet(run))
    diverged = (folder / DIVERGED).exists()
    result = {
        "scene": entrant.plan.scene,
        "varied": entrant.plan.varied,
        "ended": f"diverged at step {int(state.step)}" if diverged else "finished",
        "scores": evaluate(run),
    }
    write_json(path, result)


if __name__ == "__main__":
    cli.main(main, huge_pages=True)
