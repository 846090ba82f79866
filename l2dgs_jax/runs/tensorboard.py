"""Events of a training for TensorBoard, written by tensorboardX."""

from pathlib import Path
from typing import Any

from l2dgs_jax.data.images import read_image, to_bytes
from l2dgs_jax.runs import previews
from l2dgs_jax.runs.recorder import terms
from l2dgs_jax.runtime.extras import extra

EVENTS_FOLDER = "tensorboard"  # in the run folder
FLUSH_INTERVAL = 10  # seconds


class TensorBoard:
    """A display (see `displays`) that writes the metrics as scalars and the previews as images."""

    def __init__(self, folder: Path):
        """Write nothing before the first event.

        Args:
            folder: of the run.

        Raises:
            UserError: tensorboardX is not installed.
        """
        self.folder, self.library, self.writer = folder, tensorboardx(), None

    def __call__(self, event: str, **facts: Any) -> None:
        """Write the event, if it is one of metrics or previews."""
        if event in ("begin", "end") and self.writer:
            self.writer.close()
            self.writer = None
        if event == "begin":
            # Events of later steps are from before the run was interrupted or went back: TensorBoard should drop them.
            lost = facts["step"] + 1
            self.writer = self.library.SummaryWriter(
                str(self.folder / EVENTS_FOLDER), purge_step=lost, filename_suffix=f".{lost}", flush_secs=FLUSH_INTERVAL
            )
        elif event == "metrics" and self.writer:
            for name, value in _scalars(facts).items():
                self.writer.add_scalar(name, value, facts["step"])
        elif event == "previews" and self.writer:
            for view, kind, step, path in previews.kept(self.folder):
                if step == facts["step"]:
                    self.writer.add_image(f"{view}/{kind}", to_bytes(read_image(path)), step, dataformats="HWC")


def tensorboardx() -> Any:
    """The package.

    Raises:
        UserError: it is not installed.
    """
    return extra("tensorboardX", "tensorboard", "--tensorboard")


def _scalars(line: dict[str, Any]) -> dict[str, float]:
    """The numbers in a line of metrics, by their TensorBoard tags."""
    found = {name: line[name] for name in ("loss", "psnr", "gaussians", "memory")}
    found |= {f"terms/{name}": value for name, value in terms(line).items()}
    found |= {f"rates/{name}": value for name, value in line["rates"].items()}
    return {name: value for name, value in found.items() if value is not None}
