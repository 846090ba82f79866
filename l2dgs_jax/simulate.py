"""`python -m l2dgs_jax.simulate SCENE OUT`: a low-light twin of a scene, with the scene itself as ground truth."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from l2dgs_jax.config import Layout
from l2dgs_jax.data import load_dataset, nerfies
from l2dgs_jax.data.images import write_image
from l2dgs_jax.preprocess.lowlight import DarkeningConfig, contact_sheet, darken, mean_report
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import new_folder, write_json

SETTINGS = "simulate.json"
CONTACT_SHEET = "contact_sheet.png"


@dataclass(frozen=True)
class Simulate:
    """Darken a well-lit scene as L2DGS and LEDNet did; writes dark frames to rgb/ and the original ones to well/.

    The twin has the layout of Nerfies. simulate.json records the settings and how dark every frame became;
    contact_sheet.png shows some frames.

    Attributes:
        scene: folder of the scene, in any known layout; if it has dark and well-lit pictures, the latter are used.
        output: new folder for the twin.
        downscale: integer factor by which to shrink the pictures.
        format: layout of the scene's folder; "auto" recognises it from its contents.
        held_out: which views are held out, as for train; frames that are neither trained on nor held out are left out.
        darkening: how the frames are darkened.
    """

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    output: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    downscale: int = 1
    format: Layout = "auto"
    held_out: str = "auto"
    darkening: Annotated[DarkeningConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=DarkeningConfig)


def main(arguments: Sequence[str]) -> None:
    """Simulate as the command line says."""
    options = command_line.parse(Simulate, arguments, "simulate")
    options.darkening.check()
    with new_folder(options.output) as folder:
        # the world as it is stored, because some presets train in it
        dataset = load_dataset(options.scene, options.downscale, options.format, options.held_out, normalise=False)
        for note in dataset.notes:
            print(f"note: {note}")
        dataset, frames = darken(dataset, options.darkening)
        nerfies.write(dataset, folder)
        mean = mean_report(frames)
        settings = dataclasses.asdict(options)
        settings |= settings.pop("darkening")
        settings = {key: str(value) if isinstance(value, Path) else value for key, value in settings.items()}
        reports = {name: report._asdict() for name, report in frames.items()}
        write_json(folder / SETTINGS, {"settings": settings, "mean": mean, "frames": reports})
        write_image(folder / CONTACT_SHEET, contact_sheet(dataset))
    decibels = "some frames unchanged" if mean["psnr"] is None else f"PSNR(low, well) {mean['psnr']:.2f} dB"
    print(
        f"{dataset.name}: {len(frames)} frames, mean level {mean['welllit_level']:.3f} -> {mean['level']:.3f}, "
        f"{decibels}; wrote {options.output}, see {options.output / CONTACT_SHEET}"
    )


if __name__ == "__main__":
    command_line.run(main)
