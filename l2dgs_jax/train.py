"""`python -m l2dgs_jax.train SCENE`: train a scene and leave a run folder with checkpoints, metrics and pictures."""

import dataclasses
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tqdm import tqdm

from l2dgs_jax import checkpoint, cli, engine, runs, visualize
from l2dgs_jax.checkpoint import Checkpoint
from l2dgs_jax.config import PRESETS, Config
from l2dgs_jax.data import load
from l2dgs_jax.data.images import write_image
from l2dgs_jax.errors import UserError

LOG_EVERY = 10  # steps between lines of the metrics file


@dataclass(frozen=True)
class Train:
    """Train a scene from a dark video with poses.

    Attributes:
        scene: folder of the scene, or "demo" for the clip that comes with the package.
        preset: settings to start from (default, paper, authors or demo); the options below override single ones.
        output: run folder; a fresh one under runs/ if not given.
        resume: continue the run in the output folder from its last checkpoint.
    """

    scene: tyro.conf.Positional[str]
    preset: str | None = None
    output: Path | None = None
    resume: bool = False
    config: Annotated[Config, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Config)


def train(arguments: Sequence[str]) -> None:
    """Train as the command line says."""
    options = _parse(arguments)
    folder, config = options.output, options.config
    assert folder is not None
    dataset = load(options.scene, config.downscale, config.format, config.held_out, config.frame_memory)
    config = engine.resolve(config, dataset.train)
    state, pair_capacity = engine.initial_state(dataset, config), None
    if options.resume:
        state, pair_capacity = checkpoint.load(folder / runs.CHECKPOINT, config, state)
    else:
        runs.write_settings(folder, options.scene, config)

    for note in dataset.notes:
        print(f"note: {note}")
    print(f"{dataset.name}: {len(dataset.train.names)} frames of {dataset.width}x{dataset.height}; run folder {folder}")
    start = int(state.step)
    try:
        _consume(engine.run(dataset.train, config, state, pair_capacity), folder, config, start)
    except engine.DivergedError as error:
        raise UserError(
            f"{folder}: {error}; expected finite values: lower the learning rates and --resume from the checkpoint"
        ) from None

    run = runs.open_run(folder)
    write_image(folder / runs.CONTACT_SHEET, visualize.contact_sheet(run))
    visualize.video(run, folder / runs.VIDEO)
    print(f"wrote {folder / runs.CONTACT_SHEET} and {folder / runs.VIDEO}")
    print(f"next: python -m l2dgs_jax.evaluate {folder}   or   python -m l2dgs_jax.render {folder}")


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
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
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
    """Show, log and save the steps of a training."""
    metrics = folder / runs.METRICS
    kept = [line for line in metrics.read_text().splitlines() if json.loads(line)["step"] <= done] if done else []
    metrics.write_text("".join(f"{line}\n" for line in kept))
    begun = time.monotonic()
    with open(metrics, "a") as log, tqdm(total=config.steps, initial=done, unit="step", dynamic_ncols=True) as bar:
        for state, report, pair_capacity in steps:
            step = int(state.step)
            bar.update()
            if step % LOG_EVERY == 0 or step == config.steps:
                stage = "coarse" if step <= config.coarse_steps else "fine"
                values = {"loss": report.loss, "psnr": report.psnr, **report.terms}
                line = {
                    "step": step,
                    "stage": stage,
                    "gaussians": int(state.scene.alive.sum()),
                    "pairs": int(report.pairs),
                }
                line |= {name: round(float(value), 6) for name, value in values.items()}
                log.write(json.dumps(line | {"seconds": round(time.monotonic() - begun, 2)}) + "\n")
                log.flush()
                bar.set_description(stage)
                bar.set_postfix_str(
                    f"loss {line['loss']:.3f}, low-light {line['psnr']:.1f} dB, {line['gaussians']} Gaussians"
                )
            if step == config.coarse_steps:
                checkpoint.save(folder / runs.COARSE, Checkpoint(state, pair_capacity), config)
            if step % config.checkpoint_every == 0 or step == config.steps:
                checkpoint.save(folder / runs.CHECKPOINT, Checkpoint(state, pair_capacity), config)


if __name__ == "__main__":
    cli.main(train)
