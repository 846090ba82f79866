"""`python -m l2dgs_jax.simulate SCENE OUT`: a low-light twin of a scene, with the scene itself as its truth."""

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
    """Darken a well-lit scene as L2DGS and LEDNet did, and write it in the layout of Nerfies: rgb dark, well as it was.

    Beside it, simulate.json says how and how dark every frame became, and contact_sheet.png shows some.

    Attributes:
        scene: folder of the scene, in any known layout; its well-lit pictures if it has both kinds.
        output: new folder for the twin.
        downscale: whole factor by which images are smaller than full size.
        format: layout of the scene's folder; "auto": found from its contents.
        held_out: rule for the views not trained on, as train has it; frames that it does not use are left out.
        darkening: how.
    """

    scene: tyro.conf.Positional[str]
    output: tyro.conf.Positional[Path]
    downscale: int = 1
    format: Layout = "auto"
    held_out: str = "auto"
    darkening: Annotated[DarkeningConfig, tyro.conf.arg(name="")] = dataclasses.field(default_factory=DarkeningConfig)


def main(arguments: Sequence[str]) -> None:
    """Simulate as the command line says."""
    options = command_line.parse(Simulate, arguments, "simulate")
    options.darkening.check()
    with new_folder(options.output) as folder:
        dataset = load_dataset(options.scene, options.downscale, options.format, options.held_out)
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
