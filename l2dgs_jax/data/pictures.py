"""Which files hold the pictures of a scene's frames."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from l2dgs_jax.data.images import SUFFIXES
from l2dgs_jax.errors import UserError

_SCALE = re.compile(r"([1-9]\d{0,3})x")


class Picture(NamedTuple):
    """A picture file and the factor by which it is already smaller than the camera's full size."""

    path: Path
    scale: int


def stored(root: Path, downscale: int, names: Sequence[str]) -> list[Picture]:
    """Each frame's `root/<k>x/<name>.<suffix>` for the largest k that divides `downscale`.

    Raises:
        UserError: there is no such k, or the picture of a frame is missing.
    """
    folder, scale = _coarsest(root, downscale)
    files = by_name(folder)
    missing = [name for name in names if name not in files]
    if missing:
        raise UserError(f"{folder / missing[0]}.png: no such file; expected the picture of frame '{missing[0]}'")
    return [Picture(files[name], scale) for name in names]


def stored_if_any(root: Path, downscale: int, names: Sequence[str]) -> list[Picture] | list[None]:
    """Like `stored`, but None for every frame if none of them has a picture.

    Raises:
        UserError: some frames have a picture and some do not.
    """
    if not root.is_dir() or not by_name(_coarsest(root, downscale)[0]).keys() & set(names):
        return [None] * len(names)
    return stored(root, downscale, names)


def copies(scene: Path, root: Path, downscale: int, names: Sequence[str]) -> list[Picture]:
    """Each frame's picture in `root`, or in `<root>_<k>` beside it for the largest such k that divides `downscale`.

    Only folders within the `scene`'s are looked at.

    Raises:
        UserError: pictures of frames are missing.
    """
    factors = [k for k in range(downscale, 1, -1) if downscale % k == 0 and root != scene]
    scale = next((k for k in factors if root.with_name(f"{root.name}_{k}").is_dir()), 1)
    folder = root if scale == 1 else root.with_name(f"{root.name}_{scale}")
    files = by_name(folder)
    missing = [name for name in names if name not in files]
    if missing:
        raise UserError(
            f"{folder}: holds {len(files)} pictures, but none of {len(missing)} of the {len(names)} frames, such as "
            f"'{missing[0]}'; expected every frame's"
        )
    return [Picture(files[name], scale) for name in names]


def by_name(folder: Path) -> dict[str, Path]:
    """Picture files by their path within the folder, without the suffix."""
    files = (path for path in sorted(folder.rglob("*")) if path.suffix.lower() in SUFFIXES)
    return {path.relative_to(folder).with_suffix("").as_posix(): path for path in files}


def _coarsest(root: Path, downscale: int) -> tuple[Path, int]:
    if not root.is_dir():
        raise UserError(f"{root}: no such folder; expected pictures in {root / '1x'}")
    held = [int(match[1]) for path in sorted(root.iterdir()) if (match := _SCALE.fullmatch(path.name))]
    scale = max((factor for factor in held if downscale % factor == 0), default=0)
    if not scale:
        found = ", ".join(f"{factor}x" for factor in held) or "no folder like 1x"
        raise UserError(f"{root}: holds {found}; expected a factor that divides --downscale {downscale}")
    return root / f"{scale}x", scale
