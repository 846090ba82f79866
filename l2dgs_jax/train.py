"""`python -m l2dgs_jax.train SCENE`: train a scene and leave a run folder with checkpoints, metrics and pictures."""

import dataclasses
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import tyro
from jax.sharding import Mesh
from tqdm import tqdm

from l2dgs_jax import checkpoint, cli, devices, engine, hosts, runs, visualize
from l2dgs_jax.config import PRESETS, Config
from l2dgs_jax.data import load
from l2dgs_jax.data.dataset import Dataset
from l2dgs_jax.data.images import write_image
from l2dgs_jax.errors import UserError
from l2dgs_jax.files import is_taken
from l2dgs_jax.hosts import Hosts
from l2dgs_jax.recording import Recorder


@dataclass(frozen=True)
class Train:
    """Train a scene from a dark video with poses.

    Attributes:
        scene: folder of the scene, or "demo" for the clip that comes with the package.
        preset: settings to start from (default, paper, authors or demo); the options below override single ones.
        output: run folder; a fresh one under runs/ if not given.
        resume: continue the run in the output folder from its last checkpoint.
        devices: how many devices the views of a step are spread over; each core of a processor is one. If not given,
            as many as share them evenly.
        hosts: several processes.
    """

    scene: tyro.conf.Positional[str]
    preset: str | None = None
    output: Path | None = None
    resume: bool = False
    devices: int | None = None
    hosts: Annotated[Hosts, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Hosts)
    config: Annotated[Config, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Config)


def train(arguments: Sequence[str]) -> None:
    """Train as the command line says."""
    devices.one_per_core()
    options = _parse(arguments)
    with hosts.together(options.hosts):
        hosts.meet("the options are checked")
        _train(options)


def _train(options: Train) -> None:
    folder, config = options.output, options.config
    assert folder is not None
    mesh = _mesh(options)
    dataset = load(options.scene, config.downscale, config.format, config.held_out, config.frame_memory)
    config = engine.resolve(config, dataset.train)
    state, pair_capacity = engine.initial_state(dataset, config), None
    if options.resume:
        state, pair_capacity = checkpoint.load(folder / runs.CHECKPOINT, config, state)
    hosts.meet("everything is read")
    steps = engine.run([engine.Member(dataset.train, config, state)], pair_capacity, mesh)
    if jax.process_index() > 0:
        deque(steps, maxlen=0)
    else:
        _record(steps, dataset, options, config, done=int(state.step))
    hosts.meet("the run is finished")


def _record(steps: Iterator[engine.Progress], dataset: Dataset, options: Train, config: Config, done: int) -> None:
    """Take the steps of a training, leave them in the run folder, and show what came of them."""
    folder = options.output
    assert folder is not None
    if not options.resume:
        runs.write_settings(folder, options.scene, config)
    for note in dataset.notes:
        print(f"note: {note}")
    print(f"{dataset.name}: {len(dataset.train.names)} frames of {dataset.width}x{dataset.height}; run folder {folder}")
    try:
        _consume(steps, folder, config, done)
    except engine.DivergedError as error:
        raise UserError(
            f"{folder}: {error}; expected finite values: lower the learning rates and --resume from the checkpoint"
        ) from None

    run = runs.open_run(folder)
    write_image(folder / runs.CONTACT_SHEET, visualize.contact_sheet(run))
    visualize.video(run, folder / runs.VIDEO)
    print(f"wrote {folder / runs.CONTACT_SHEET} and {folder / runs.VIDEO}")
    print(f"next: python -m l2dgs_jax.evaluate {folder}   or   python -m l2dgs_jax.render {folder}")


def _mesh(options: Train) -> Mesh | None:
    """The devices that the views of a step are spread over."""
    views = options.config.batch_size
    count = devices.shares(views) if options.devices is None else options.devices
    if count < 1 or views % count:
        raise UserError(f"--devices {count}: expected a number that divides --batch-size, which is {views}")
    try:
        return devices.mesh(views=count)
    except ValueError as error:
        raise UserError(f"--devices {count}: {error}; expected what there is") from None


def _parse(arguments: Sequence[str]) -> Train:
    """Parse twice: preset, scene and run folder decide what the other options override."""
    first = cli.parse(Train, arguments, "train")
    if first.scene != "demo":
        first = dataclasses.replace(first, scene=str(Path(first.scene).absolute()))
    folder = first.output or _run_folder(first.scene, first.resume)
    if first.resume:
        base = runs.read_settings(folder)[1]
    else:
        preset = first.preset or ("demo" if first.scene == "demo" else "default")
        if preset not in PRESETS:
            raise UserError(f"--preset {preset}: no such preset; expected one of {', '.join(PRESETS)}")
        base = PRESETS[preset]
        if is_taken(folder):
            raise UserError(
                f"{folder}: already holds another run or files; expected a new folder for --output, or --resume"
            )
    options = cli.parse(Train, arguments, "train", dataclasses.replace(first, config=base))
    if options.config.steps < 1 or min(options.config.coarse_steps, options.config.fine_steps) < 0:
        raise UserError("--coarse-steps and --fine-steps: expected no negative number and at least one step in all")
    return dataclasses.replace(options, scene=first.scene, output=folder)


def _run_folder(scene: str, resume: bool) -> Path:
    """runs/NAME, runs/NAME-2 ...: the first that is free, or with `resume` the last that is not."""
    name, taken = Path(scene).name, 0
    candidate = lambda index: Path("runs") / (name if index == 1 else f"{name}-{index}")
    while candidate(taken + 1).exists():
        taken += 1
    if resume and not taken:
        raise UserError(f"{candidate(1)}: no run to resume; expected a folder that train wrote, see --output")
    return candidate(taken if resume else taken + 1)


def _consume(steps: Iterator[engine.Progress], folder: Path, config: Config, done: int) -> None:
    """Record the steps of a training and show how it goes."""
    record = Recorder(folder, config, done)
    with tqdm(total=config.steps, initial=done, unit="step", dynamic_ncols=True) as bar:
        for progress in steps:
            bar.update()
            line = record(progress)
            if line:
                bar.set_description(line["stage"])
                bar.set_postfix_str(
                    f"loss {line['loss']:.3f}, low-light {line['psnr']:.1f} dB, {line['gaussians']} Gaussians"
                )


if __name__ == "__main__":
    cli.main(train, huge_pages=True)
