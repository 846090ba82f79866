"""The folder of a training run: what lies where, and how the other commands open it."""

import json
from dataclasses import dataclass
from pathlib import Path

from l2dgs_jax import checkpoint, engine
from l2dgs_jax.config import Config, from_dict, to_dict
from l2dgs_jax.data import load
from l2dgs_jax.data.dataset import Dataset
from l2dgs_jax.errors import UserError
from l2dgs_jax.files import make_folder, write_json
from l2dgs_jax.rendering import Renderer
from l2dgs_jax.step import TrainState, sh_degree

SETTINGS = "config.json"
CHECKPOINT = "checkpoint.npz"
COARSE = "coarse.npz"  # the state at the end of the coarse stage
METRICS = "metrics.jsonl"
CONTACT_SHEET = "contact_sheet.png"
VIDEO = "video.mp4"


@dataclass(frozen=True)
class Run:
    """A run opened for rendering.

    Attributes:
        folder: where it lies.
        config: its settings.
        dataset: the scene it was trained on.
        state: the loaded training state.
    """

    folder: Path
    config: Config
    dataset: Dataset
    state: TrainState

    @property
    def moving(self) -> bool:
        """Whether the state is past the coarse stage."""
        return int(self.state.step) > self.config.coarse_steps

    def renderer(self) -> Renderer:
        """Renders views of this run's scene at the dataset's resolution."""
        return Renderer(
            self.state.scene,
            self.config.model,
            self.dataset.width,
            self.dataset.height,
            moving=self.moving,
            sh_degree=int(sh_degree(int(self.state.step), self.config)),
        )


def write_settings(folder: Path, scene: str, config: Config) -> None:
    """Create the run folder and its `config.json`.

    Raises:
        UserError: the folder cannot be made or written to.
    """
    make_folder(folder)
    write_json(folder / SETTINGS, {"scene": scene, "settings": to_dict(config)})


def read_settings(folder: Path) -> tuple[str, Config]:
    """The scene and the settings of a run.

    Raises:
        UserError: the folder is no run, or its settings cannot be read.
    """
    path = folder / SETTINGS
    try:
        content = json.loads(path.read_text())
        return content["scene"], from_dict(content["settings"])
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"{folder}: not a training run; expected a folder with {SETTINGS}") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: unreadable settings ({error}); expected those that train wrote") from None


def open_run(folder: Path, stage: str = "final") -> Run:
    """Open a run's last checkpoint (`stage` "final") or the one at the end of its coarse stage ("coarse").

    Raises:
        UserError: settings, scene or checkpoint are missing or do not fit together.
    """
    scene, config = read_settings(folder)
    path = folder / {"final": CHECKPOINT, "coarse": COARSE}[stage]
    if not path.exists():
        raise UserError(f"{path}: no such checkpoint; expected a run that has got that far")
    dataset = load(scene, config.downscale, config.format, config.held_out, config.frame_memory)
    state = checkpoint.load(path, config, engine.initial_state(dataset, config)).state
    return Run(folder, config, dataset, state)
