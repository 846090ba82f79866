"""`python -m l2dgs_jax.train SCENE`: train a scene and leave a run folder with checkpoints, metrics and pictures."""

import contextlib
import dataclasses
import functools
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import tyro

from l2dgs_jax import runs
from l2dgs_jax.config import PRESETS, Config
from l2dgs_jax.data import Dataset, load_dataset
from l2dgs_jax.data.images import write_image
from l2dgs_jax.errors import DISK_FULL, Interrupted, UserError
from l2dgs_jax.preprocess.enhancement import enhanced
from l2dgs_jax.runs import Checkpoint, Run, displays
from l2dgs_jax.runs.advice import misfit
from l2dgs_jax.runs.displays import Display
from l2dgs_jax.runs.divergence import standing
from l2dgs_jax.runs.persistence import LESS_MEMORY, fit_in_folder
from l2dgs_jax.runs.report import REPORT, Report
from l2dgs_jax.runs.tensorboard import TensorBoard, tensorboardx
from l2dgs_jax.runtime import command_line, devices, distributed
from l2dgs_jax.runtime.distributed import Hosts
from l2dgs_jax.runtime.files import is_taken, is_writable, new_folder
from l2dgs_jax.runtime.locks import locked
from l2dgs_jax.runtime.memory import memory_errors
from l2dgs_jax.runtime.signals import stop_requests
from l2dgs_jax.training import Progress, initial_state, resolve
from l2dgs_jax.viewer.live import live
from l2dgs_jax.viewer.server import check
from l2dgs_jax.visualize import contact_sheet, write_run_video

_Flag = tyro.conf.FlagCreatePairsOff[bool]


@dataclass(frozen=True)
class Train:
    """Train a scene from a dark video with poses.

    Attributes:
        scene: folder of the scene, or "demo" for the clip that comes with the package.
        preset: settings that a new run starts from, which the options below override one by one; the defaults shown
            here are the preset's. Number of steps: demo 400, fast 600, default 1200 (about ten minutes on one core for
            frames of 200x112, longer for more pixels or points), best 5000, authors 17000, paper 23000; 1200 each for
            the baselines 4dgs, enhance-4dgs, curve-4dgs and static.
        output: run folder; a new one under runs/ if not given.
        resume: continue the run in the output folder from its last checkpoint.
        devices: number of devices to spread the views of a step over; every CPU core is one. If not given, as many as
            get equal shares.
        quiet: show nothing but warnings and errors.
        json: print progress as JSON, one object per line (see docs/training.md).
        report: do not write report.html, the page in the run folder that shows the progress of the training.
        tensorboard: write events for TensorBoard to the run folder; needs the extra "tensorboard".
        view: show the scene in the browser while it trains; needs the extra "view".
        view_host: address that the viewer listens at; 0.0.0.0 admits every machine on the network.
        view_port: port that the viewer listens at, or the next free one.
        hosts: training on several hosts.
    """

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    preset: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    output: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    resume: _Flag = False
    devices: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    quiet: _Flag = False
    json: _Flag = False
    report: Annotated[_Flag, tyro.conf.arg(help_behavior_hint="(default: it is written)")] = True
    tensorboard: _Flag = False
    view: _Flag = False
    view_host: str = "127.0.0.1"
    view_port: int = 8080
    hosts: Annotated[Hosts, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Hosts)
    config: Annotated[Config, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Config)


def main(arguments: Sequence[str]) -> None:
    """Train as the command line says."""
    devices.one_per_core()
    options = _parse(arguments)
    with distributed.process_group(options.hosts):
        distributed.barrier("the options are checked")
        _train(options)


def _train(options: Train) -> None:
    folder, config, first = options.output, options.config, jax.process_index() == 0
    assert folder is not None
    _check_devices(options)
    if first and not is_writable(folder.parent):
        raise UserError(f"{folder}: cannot be created; expected an --output in a writable folder")
    if options.tensorboard and first:
        tensorboardx()
    if options.view and first:
        check(options.view_host, options.view_port, "view-")
    with contextlib.ExitStack() as stack:
        if options.resume and first:
            stack.enter_context(locked(folder))
        with memory_errors(lambda: "before the first step", LESS_MEMORY):
            dataset = load_dataset(options.scene, **config.reading)
            dataset = enhanced(dataset, config.enhance, int(config.seed))
            config = resolve(config, dataset)
            # A training that cannot start should leave no folder behind.
            start = standing(folder, dataset, config) if options.resume else Checkpoint(initial_state(dataset, config))
        distributed.barrier("everything is read")
        if first:
            if options.resume:
                runs.follow_scene(folder, options.scene)
            else:
                with new_folder(folder) as place:
                    runs.write_settings(place, options.scene, config)
                stack.enter_context(locked(folder))
            with _display(options) as display, _end_reported(display):
                _record(dataset, options, config, start, display)
        else:
            runs.fit(dataset, config, start=start, device_count=options.devices)
        distributed.barrier("the run is finished")


@contextlib.contextmanager
def _display(options: Train) -> Iterator[Display]:
    """Everything that shows the progress of the training."""
    folder = options.output
    assert folder is not None
    with displays.choose(options.quiet, options.json) as display:
        shown = [display]
        if options.report:
            shown.append(Report(folder))
        if options.tensorboard:
            shown.append(TensorBoard(folder))
        yield displays.together(shown)


def _record(dataset: Dataset, options: Train, config: Config, start: Checkpoint, display: Display) -> None:
    """Train, record the steps in the run folder, and then write the contact sheet and the video."""
    folder = options.output
    assert folder is not None
    display("start", scene=dataset.name, run=str(folder), step=int(start.state.step), steps=config.steps)
    for note in dataset.notes:
        print(f"note: {note}")
    warning = misfit(dataset, config)
    if warning:
        print(f"warning: {warning}", file=sys.stderr)
    print(f"{dataset.name}: {len(dataset.train.names)} frames of {dataset.width}x{dataset.height}; run folder {folder}")
    if options.report:
        print(f"watch it in a browser: {(folder / REPORT).absolute().as_uri()}")
    run = _fit(dataset, options, config, start, display)
    write_image(folder / runs.CONTACT_SHEET, contact_sheet(run))
    video = write_run_video(run, folder / runs.VIDEO, quiet=options.quiet)
    print(f"wrote {folder / runs.CONTACT_SHEET} and {video}")
    quoted = shlex.quote(str(folder))
    print(f"next: python -m l2dgs_jax.evaluate {quoted}   or   python -m l2dgs_jax.render {quoted}")


def _fit(dataset: Dataset, options: Train, config: Config, start: Checkpoint, display: Display) -> Run:
    """Train, and say how to continue if the training is stopped."""
    folder = options.output
    assert folder is not None
    notice = "stopping after this step; Ctrl-C now stops at once, and loses the steps since the last checkpoint"
    command = shlex.join(["python", "-m", "l2dgs_jax.train", options.scene, "--output", str(folder), "--resume"])
    try:
        with (
            stop_requests(lambda: display("stopping", message=notice)) as stopping,
            _watching(dataset, options, config, display) as watch,
        ):
            previews = options.report or options.tensorboard
            return fit_in_folder(
                folder, dataset, config, start, display, stopping, options.devices, with_previews=previews, watch=watch
            )
    except Interrupted as stop:
        raise Interrupted(f"{stop}; go on with: {command}", stop.code) from None
    except UserError as error:
        if error.code != DISK_FULL:
            raise
        raise UserError(f"{error}, then go on with: {command}", DISK_FULL) from None


@contextlib.contextmanager
def _watching(
    dataset: Dataset, options: Train, config: Config, display: Display
) -> Iterator[Callable[[Progress], None] | None]:
    """Serve the viewer if --view is given; yields what to call after every step, or None."""
    if not options.view:
        yield None
        return
    host = options.view_host
    told = lambda port: display("viewer", message=f"fly through it in a browser: http://{host}:{port}")
    with live(dataset, config, host, options.view_port, told) as watch:
        yield watch


@contextlib.contextmanager
def _end_reported(display: Display) -> Iterator[None]:
    """Report how the training ended as an event, for programs; people read the error itself."""
    try:
        yield
    except (UserError, Interrupted) as end:
        display("end", code=end.code, reason=str(end))
        raise
    display("end", code=0)


def _parse(arguments: Sequence[str]) -> Train:
    """Parse twice: preset, scene and run folder decide what the other options override."""
    if command_line.HELP_OPTIONS & set(arguments):
        _show_help(arguments)
    first = command_line.parse(Train, arguments, "train")
    if first.scene != "demo":
        place = Path(first.scene).absolute()
        # The run folder is named after the scene's, and ".." is no name.
        first = dataclasses.replace(first, scene=str(place.resolve() if place.name == ".." else place))
    folder = first.output or _run_folder(first.scene, first.resume)
    if first.resume:
        if first.preset:
            raise UserError(f"--preset {first.preset}: expected none with --resume, which keeps the run's settings")
        runs.check_scene(folder, first.scene)
        base = runs.read_settings(folder)[1]
    else:
        base = PRESETS[_preset(first)]
        if is_taken(folder):
            raise UserError(
                f"{folder}: already holds another run or files; expected a new folder for --output, or --resume"
            )
    options = command_line.parse(Train, arguments, "train", Train(scene=first.scene, config=base))
    options.config.check()
    return dataclasses.replace(options, scene=first.scene, output=folder)


def _show_help(arguments: Sequence[str]) -> None:
    """Show the help with the preset's settings as defaults, and exit."""
    asked = [argument for argument in arguments if argument not in command_line.HELP_OPTIONS]
    preset = _preset(command_line.parse(Train, asked, "train", Train(scene="")))
    # Not an instance, which would need a scene: the help should show the scene as required.
    shown = functools.partial(Train, preset=preset, hosts=Hosts(), config=PRESETS[preset])
    command_line.parse(shown, ["--help"], "train")


def _preset(options: Train) -> str:
    """The preset that is asked for, or else the scene's default one."""
    preset = options.preset or ("demo" if options.scene == "demo" else "default")
    if preset not in PRESETS:
        raise UserError(f"--preset {preset}: no such preset; expected one of {', '.join(PRESETS)}")
    return preset


def _run_folder(scene: str, resume: bool) -> Path:
    """runs/NAME, runs/NAME-2 ...: the first that does not exist, or with `resume` the last that does."""
    name, taken = Path(scene).name, 0

    def candidate(index: int) -> Path:
        return Path("runs") / (name if index == 1 else f"{name}-{index}")

    while candidate(taken + 1).exists():
        taken += 1
    if resume and not taken:
        raise UserError(f"{candidate(1)}: no run to resume; expected a folder that train wrote, see --output")
    return candidate(taken if resume else taken + 1)


def _check_devices(options: Train) -> None:
    """Fail early if the views of a step cannot be spread over the number of devices asked for."""
    views = options.config.batch_size
    count = devices.shares(views) if options.devices is None else options.devices
    if count < 1 or views % count:
        raise UserError(f"--devices {count}: expected a number that divides --batch-size, which is {views}")
    try:
        devices.mesh(views=count)
    except ValueError as error:
        raise UserError(f"--devices {count}: {error}; expected what there is") from None


if __name__ == "__main__":
    command_line.run(main, huge_pages=True)
