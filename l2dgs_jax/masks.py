"""`python -m l2dgs_jax.masks SCENE`: masks of what moves, for scoring the dynamic and the static region."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from l2dgs_jax.config import Layout
from l2dgs_jax.data import load_dataset
from l2dgs_jax.data.images import SUFFIXES, write_image
from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.motion_masks import as_taken, compute_masks, preview, write_masks
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import takes_file


@dataclass(frozen=True)
class Masks:
    """Find what moves and write SCENE/mask/1x/NAME.png for every frame: 255 where something moves, 0 elsewhere.

    Masks match the scene's original pictures: full size, with lens distortion.

    Attributes:
        scene: folder of the scene.
        downscale: integer factor by which to shrink the pictures for the computation.
        format: layout of the scene's folder; "auto" recognises it from its contents.
        held_out: which views are held out, as for train; frames that are neither trained on nor held out get no mask.
        overwrite: replace the masks that the scene already has, at every scale.
        preview: picture to write that shows some frames with the moving regions tinted.
    """

    scene: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE")]
    downscale: int = 1
    format: Layout = "auto"
    held_out: str = "auto"
    overwrite: bool = False
    preview: Path | None = None


def main(arguments: Sequence[str]) -> None:
    """Write the masks of a scene as the command line says."""
    options = command_line.parse(Masks, arguments, "masks")
    if options.scene == Path("demo") and not options.scene.exists():
        raise UserError("demo: this clip has no folder to write masks to; expected a scene's folder")
    folder = options.scene / "mask"
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file; expected a folder, or nothing, to write masks to")
    if not options.overwrite and folder.exists() and any(folder.iterdir()):
        raise UserError(f"{folder}: holds masks of this scene; expected none, or --overwrite to replace them")
    dataset = load_dataset(options.scene, options.downscale, options.format, options.held_out)
    if not os.access(options.scene, os.W_OK):
        raise UserError(f"{options.scene}: cannot be written; expected a writable folder to put masks in")
    if options.preview and not takes_file(options.preview):
        raise UserError(f"--preview {options.preview}: cannot be written; expected a file in a writable folder")
    if options.preview and options.preview.suffix.lower() not in SUFFIXES:
        raise UserError(f"--preview {options.preview}: not a picture's suffix; expected one of {', '.join(SUFFIXES)}")
    for note in dataset.notes:
        print(f"note: {note}")

    masks = compute_masks(dataset)
    names = [*dataset.train.names, *dataset.test.names]
    originals = [*dataset.train.originals, *dataset.test.originals]
    pictures = [as_taken(mask, options.downscale, original) for mask, original in zip(masks, originals, strict=True)]
    write_masks(folder, names, pictures)
    print(f"wrote {len(names)} masks to {folder / '1x'}; {100 * masks.mean():.1f} % of the pixels move")
    if options.preview:
        write_image(options.preview, preview(dataset, masks))


if __name__ == "__main__":
    command_line.run(main)
