"""What the writers of all layouts share: pictures, ground truth, masks and depth, lists of frames and instants."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.data.dataset import Dataset
from l2dgs_jax.data.images import to_bytes, write_image
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.files import write_json


def write_pictures(dataset: Dataset, root: Path, folder: Path) -> None:
    """Write the frames as `root/<name>.png`, alpha 0 where not valid; ground truth, masks and depth go to `folder`.

    Raises:
        UserError: a file cannot be written, or a frame's name leads out of `root`.
    """
    for name in (*dataset.train.names, *dataset.test.names):
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise UserError(
                f"frame '{name}': the name leads out of the scene's folder; expected one without '..' or root"
            )
    for part, split in (("train", dataset.train), ("val", dataset.test)):
        kinds: list[tuple[Path, Any]] = [
            (folder / "well" / "1x", split.welllit),
            (folder / "mask" / "1x", split.masks),
            (folder / "covisible" / "1x" / part, split.covisible),
        ]
        for i, name in enumerate(split.names):
            pixels = to_bytes(split.images[i])
            if split.valid is not None:
                pixels = np.dstack([pixels, to_bytes(split.valid[i])])
            _write(root / f"{name}.png", pixels)
            for kind, values in kinds:
                if values is not None:
                    _write(kind / f"{name}.png", to_bytes(values[i]))
            if split.depths is not None:
                path = folder / "depth" / "1x" / f"{name}.npy"
                path.parent.mkdir(parents=True, exist_ok=True)
                np.save(path, split.depths[i])


def write_lists(dataset: Dataset, folder: Path) -> None:
    """Write `dataset.json`, with the held-out frames, and `metadata.json`, with the instants."""
    train, val = dataset.train, dataset.test
    times = {
        name: float(time) for split in (train, val) for name, time in zip(split.names, split.cameras.time, strict=True)
    }
    lists = {"count": len(times), "ids": sorted(times), "train_ids": train.names, "val_ids": val.names}
    instants = {time: rank for rank, time in enumerate(sorted(set(times.values())))}
    write_json(folder / "dataset.json", lists)
    # "warp_id" is for other programs, which read integers only.
    write_json(
        folder / "metadata.json", {name: {"warp_id": instants[time], "time": time} for name, time in times.items()}
    )


def _write(path: Path, pixels: Shaped[np.ndarray, "H W *C"]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, pixels)
