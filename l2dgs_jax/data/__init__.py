"""Scenes on disk to arrays in memory."""

from pathlib import Path

from l2dgs_jax.data import demo, nerfies
from l2dgs_jax.data.dataset import Dataset
from l2dgs_jax.errors import UserError

_READERS = (nerfies,)


def load(scene: str | Path, downscale: int = 1) -> Dataset:
    """Read a scene, whichever of the known layouts it has.

    Args:
        scene: its folder, or "demo" for the clip that comes with the package.
        downscale: whole factor by which images are smaller than full size.

    Raises:
        UserError: anything in the scene is missing, malformed or inconsistent.
    """
    if downscale < 1:
        raise UserError(f"--downscale {downscale}: expected a whole number from 1")
    folder = demo.FOLDER if scene == "demo" else Path(scene)
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; expected a scene's folder, or 'demo'")
    for reader in _READERS:
        if reader.recognizes(folder):
            return reader.read(folder, downscale)
    if not any(folder.iterdir()):
        raise UserError(f"{folder}: the folder is empty; expected a scene")
    raise UserError(f"{folder}: not a known layout; expected camera/ and rgb/ as Nerfies and HyperNeRF have them")
