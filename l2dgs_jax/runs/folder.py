"""The folder of a training run: its files, and how the other commands open it."""

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal

from l2dgs_jax.config import Config, from_dict, to_dict
from l2dgs_jax.data import Dataset, load_dataset
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs import checkpoints
from l2dgs_jax.runs.checkpoints import Checkpoint
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runtime.files import make_folder, new_folder, write_json
from l2dgs_jax.training import initial_state

SETTINGS = "config.json"
CHECKPOINT = "checkpoint.npz"  # the last one; earlier ones are checkpoint-1.npz, checkpoint-2.npz ...
COARSE = "coarse.npz"  # the checkpoint at the end of the coarse stage
METRICS = "metrics.jsonl"
CONTACT_SHEET = "contact_sheet.png"
VIDEO = "video"  # without its suffix, which depends on the format


def write_settings(folder: Path, scene: str, config: Config) -> None:
    """Create the run folder and its `config.json`.

    Raises:
        UserError: the folder cannot be created or written to.
    """
    make_folder(folder)
    write_json(folder / SETTINGS, {"scene": scene, "settings": to_dict(config)})


def read_settings(folder: Path) -> tuple[str, Config]:
    """The scene and the settings of a run.

    Raises:
        UserError: the folder is not that of a run, or its settings cannot be read.
    """
    path = folder / SETTINGS
    try:
        content = json.loads(path.read_text())
        if not isinstance(content["scene"], str):
            raise TypeError("the scene is no name of a folder")
        return content["scene"], from_dict(content["settings"])
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"{folder}: not a training run; expected a folder with {SETTINGS}") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path}: unreadable settings ({error}); expected those that train wrote") from None


def check_scene(folder: Path, scene: str) -> None:
    """Check that a run can continue on a scene: it is the run's own, or where that may have been moved.

    Args:
        folder: of the run.
        scene: absolute path of the scene's folder, or "demo".

    Raises:
        UserError: the run's own scene is another one that still exists, or one of the two is the demo.
    """
    own, _ = read_settings(folder)
    if scene == own:
        return
    if "demo" in (own, scene) or (Path(own).exists() and Path(scene).exists() and not Path(scene).samefile(own)):
        raise UserError(f"{scene}: not the scene of {folder}; expected {own}, or a new folder for --output")


def follow_scene(folder: Path, scene: str) -> None:
    """Record where the scene of a run has been moved, if its folder no longer exists.

    Raises:
        UserError: the settings cannot be written.
    """
    own, config = read_settings(folder)
    if own != "demo" and not Path(own).exists():
        write_settings(folder, scene, config)


def save_run(run: Run, folder: str | Path) -> Run:
    """Write a run's settings and state to a new folder, which the commands and `open_run` can open.

    Args:
        run: as `fit` returns it.
        folder: to create.

    Returns:
        The same run with its `folder` set.

    Raises:
        UserError: the folder is not empty or cannot be written, or the run's data set was not read by `load_dataset`.
    """
    folder = Path(folder)
    if run.dataset.source is None:
        raise UserError(f"{run.name}: was not read from a scene; expected a data set that load_dataset returned")
    with new_folder(folder) as place:
        write_settings(place, run.dataset.source.scene, run.config)
        checkpoints.save(place / CHECKPOINT, Checkpoint(run.state), run.config)
    return dataclasses.replace(run, folder=folder)


def open_run(folder: str | Path, stage: Literal["final", "coarse"] = "final") -> Run:
    """Open a run's folder.

    Args:
        folder: that `train`, `sweep` or `save_run` has written.
        stage: "final" for the last undamaged checkpoint, "coarse" for the one at the end of the coarse stage.

    Raises:
        UserError: settings, scene or checkpoint are missing or do not match.
    """
    folder = Path(folder)
    scene, config = read_settings(folder)
    path = folder / {"final": CHECKPOINT, "coarse": COARSE}[stage]
    if not checkpoints.kept(path):
        raise UserError(f"{path}: no such checkpoint; expected a run that has got that far")
    if scene != "demo" and not Path(scene).exists():
        raise UserError(f"{folder / SETTINGS}: names the scene {scene}, which is not there; expected its new place")
    dataset = load_dataset(scene, **config.reading)
    state = checkpoints.load_last(path, config, len(dataset.train.names)).state
    return Run(config, dataset, state, folder)


def is_needed(path: Path, folder: Path) -> bool:
    """Whether a file is a run's settings, metrics or one of its checkpoints, which other output must not replace."""
    kept = (file for name in (CHECKPOINT, COARSE) for file in checkpoints.kept(folder / name))
    own = (folder / SETTINGS, folder / METRICS, *kept)
    return path.exists() and any(file.exists() and path.samefile(file) for file in own)


def last_checkpoint(folder: Path, dataset: Dataset, config: Config, skip: int = 0) -> Checkpoint:
    """The last undamaged checkpoint of a run folder, or the initial state if it has none.

    Args:
        folder: of the run.
        dataset: its scene.
        config: its settings, resolved by `training.resolve`.
        skip: see `checkpoints.load_last`.

    Raises:
        UserError: all checkpoints are damaged, or they or the folder's settings are other ones.
    """
    path = folder / CHECKPOINT
    if not checkpoints.kept(path):
        if (folder / SETTINGS).exists():
            checkpoints.check_settings(folder / SETTINGS, read_settings(folder)[1], config)
        return Checkpoint(initial_state(dataset, config))
    return checkpoints.load_last(path, config, len(dataset.train.names), skip)


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """The lines of a run's metrics; stops at a line that an interruption has left incomplete."""
    path = folder / METRICS
    lines = []
    for line in path.read_text(errors="replace").splitlines() if path.exists() else ():
        try:
            content = json.loads(line)
        except ValueError:
            break
        lines.append(content | {"psnr": float(content["psnr"])})  # infinite if a step had no valid pixel
    return lines
