"""Finding the files of the pictures of a scene's frames."""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from l2dgs_jax.data.images import SUFFIXES, read_header
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
    return [Picture(only(files[name]), scale) for name in names]


def stored_if_any(root: Path, downscale: int, names: Sequence[str], all_or_none: bool) -> tuple[list[Picture], str]:
    """Like `stored`, but returns no pictures if they cannot be used, and then a note if there are some.

    Args:
        root: folder that holds `<k>x/<name>.<suffix>`.
        downscale: what k must divide.
        names: of the frames.
        all_or_none: whether it is an error if only some of the frames have a picture; otherwise none is used.

    Raises:
        UserError: `all_or_none`, and some frames have a picture and some do not.
    """
    if not root.is_dir():
        return [], ""
    held, scale = scales(root, downscale)
    if not scale:
        return [], f"{root.name}/ holds {held}: not used at --downscale {downscale}"
    has = by_name(root / f"{scale}x").keys() & set(names)
    if len(has) == len(names) or (has and all_or_none):
        return stored(root, downscale, names), ""
    missing = next(name for name in names if name not in has)
    some = f"{root.name}/{scale}x/ has pictures of {len(has)} of {len(names)} frames, but not of '{missing}': not used"
    return [], some if has else ""


def copies(scene: Path, root: Path, downscale: int, files: Mapping[str, str], in_order: bool = False) -> list[Picture]:
    """Each frame's picture in `root`, or in `<root>_<k>` beside it for the largest such k that divides `downscale`.

    Folders `<root>_<k>` are ignored if `root` is the scene's own folder, because they would lie outside the scene.

    Args:
        scene: the scene's folder.
        root: the folder of the pictures in full size.
        downscale: what k must divide.
        files: for each frame's name, without a suffix, the path of its file within `root`; where that does not exist, a
            file of another suffix is used.
        in_order: whether copies that are called otherwise belong to the pictures in the order of names, if they are
            equally many.

    Raises:
        UserError: pictures of frames are missing, or several files could be meant.
    """
    factors = [k for k in range(downscale, 1, -1) if downscale % k == 0 and root != scene]
    scale = next((k for k in factors if root.with_name(f"{root.name}_{k}").is_dir()), 1)
    folder = root if scale == 1 else root.with_name(f"{root.name}_{scale}")
    found = by_name(folder)
    if in_order and scale > 1 and not found.keys() & files.keys():
        originals = by_name(root)
        if len(originals) == len(found):
            found = dict(zip(originals, found.values(), strict=True))
    missing = [name for name in files if name not in found]
    if missing:
        raise UserError(
            f"{folder}: holds {len(found)} pictures, but none for {len(missing)} of the {len(files)} frames, such as "
            f"'{missing[0]}'; expected one for every frame"
        )
    return [Picture(only(found[name], folder / file), scale) for name, file in files.items()]


def by_name(folder: Path, suffixes: Sequence[str] = SUFFIXES) -> dict[str, list[Path]]:
    """Picture files, or files with other `suffixes`, by their path in the folder without suffix; none hidden.

    They are in the order of their paths with suffix.
    """
    files: dict[str, list[Path]] = {}
    for path in sorted(_visible(folder)):
        if path.suffix.lower() in suffixes:
            files.setdefault(path.relative_to(folder).with_suffix("").as_posix(), []).append(path)
    return files


def _visible(folder: Path) -> Iterator[Path]:
    """The files in a folder but hidden ones, such as macOS writes beside files; follows links that do not lead back."""
    for top, folders, files in os.walk(folder, followlinks=True):
        place, resolved = Path(top), Path(top).resolve()
        visible = [name for name in folders if not name.startswith(".")]
        folders[:] = [name for name in visible if not resolved.is_relative_to((place / name).resolve())]
        yield from (place / name for name in files if not name.startswith("."))


def only(files: Sequence[Path], meant: Path | None = None) -> Path:
    """Of the picture files of one name, the one that is `meant`, or else the only one.

    Raises:
        UserError: there are several, and none of them is `meant`.
    """
    if meant and meant in files:
        return meant
    if len(files) > 1:
        raise UserError(f"{files[0]}: differs from {files[1].name} only in its suffix; expected one file per frame")
    return files[0]


def is_turned(picture: Picture, size: tuple[int, int]) -> bool:
    """Whether only once turned as EXIF says a picture fits its camera.

    Programs that find cameras, such as COLMAP, ignore EXIF's orientation.

    Args:
        picture: file of a frame.
        size: width and height of its camera in full size.

    Raises:
        UserError: the file cannot be read.
    """
    header = read_header(picture.path)
    fits = lambda found: all(abs(a - b / picture.scale) < 1 for a, b in zip(found, size, strict=True))
    return header.orientation >= 5 and fits(header.size) and not fits(header.size[::-1])


def _coarsest(root: Path, downscale: int) -> tuple[Path, int]:
    if not root.is_dir():
        raise UserError(f"{root}: no such folder; expected pictures in {root / '1x'}")
    held, scale = scales(root, downscale)
    if not scale:
        raise UserError(f"{root}: holds {held}; expected a factor that divides --downscale {downscale}")
    return root / f"{scale}x", scale


def scales(root: Path, downscale: int) -> tuple[str, int]:
    """The factors k of the folders `<k>x` as text, and the largest of them that divides `downscale`, or else 0."""
    held = sorted(int(match[1]) for path in root.iterdir() if (match := _SCALE.fullmatch(path.name)))
    largest = max((factor for factor in held if downscale % factor == 0), default=0)
    return ", ".join(f"{factor}x" for factor in held) or "no folder like 1x", largest
