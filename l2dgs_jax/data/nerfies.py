"""Reader of the layout of Nerfies (arXiv 2011.12948), HyperNeRF and their kin.

    camera/<id>.json   rgb/<k>x/<id>.png   dataset.json   [metadata.json]   [scene.json]
    points.npy   [points_rgb.npy]   [well/<k>x/<id>.png]   [mask/<k>x/<id>.png]

Instead of the lists in `dataset.json` there may be `splits/{train,val}.json` (DyCheck, arXiv 2210.13445).
"""

import json
import re
import reprlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from l2dgs_jax.data.dataset import Dataset, Frame, Picture, assemble
from l2dgs_jax.data.images import SUFFIXES
from l2dgs_jax.errors import UserError

_SCALE = re.compile(r"([1-9]\d*)x")
_JSON_NAMES: dict[type, str] = {dict: "object", list: "array"}


def recognizes(folder: Path) -> bool:
    """Whether the folder has this layout."""
    return (folder / "camera").is_dir()


def read(folder: Path, downscale: int) -> Dataset:
    """Read a scene. World units are those of the scene file: X' = (X - center) * scale.

    Args:
        folder: of the scene.
        downscale: factor on the full size of the images.

    Raises:
        UserError: a file is missing, malformed or inconsistent.
    """
    train, val, times = _split(folder)
    center, scale = _normalization(folder)
    points, colors = _points(folder)

    def frames(names: list[str]) -> list[Frame]:
        kinds = [_pictures(folder / kind, downscale, names, kind != "rgb") for kind in ("rgb", "well", "mask")]
        return [
            _frame(folder / "camera" / f"{name}.json", center, scale, times[name], *pictures)
            for name, *pictures in zip(names, *kinds, strict=True)
        ]

    world = ((points - center) * scale).astype(np.float32)
    return assemble(folder.resolve().name, frames(train), frames(val), world, colors, downscale)


def _split(folder: Path) -> tuple[list[str], list[str], dict[str, float]]:
    """Identifiers of the training and the held-out frames, and the instant of every listed frame."""
    path = folder / "dataset.json"
    has_splits = (folder / "splits").is_dir()
    content = {} if has_splits and not path.exists() else _read_json(path, "the lists of frames")
    if has_splits and not {"ids", "train_ids"} & content.keys():
        path = folder / "splits" / "val.json"
        train, val = (
            _names(file, _read_json(file, "a list of frames"), "frame_names")
            for file in (path.with_name("train.json"), path)
        )
        ids: list[str] = []
    else:
        ids = _names(path, content, "ids") if "ids" in content else []
        train = _names(path, content, "train_ids") if "train_ids" in content or not ids else []
        val = _names(path, content, "val_ids") if "val_ids" in content else []
    listed = ids if set(train + val) <= set(ids) else sorted({*train, *val})
    if not val:
        # The rule of 4DGS (arXiv 2310.08528) for clips of one camera: train on every fourth frame, score halfway.
        train, val = listed[::4], listed[2::4][: (len(listed) - 1) // 4]
    if len(train) < 2 or not val:
        raise UserError(
            f"{path}: {len(train)} frames to train with and {len(val)} held out, of {len(listed)} listed; expected at "
            "least 2 and 1, or 5 in all if none is marked as held out"
        )
    return train, val, _times(folder / "metadata.json", listed)


def _times(path: Path, names: list[str]) -> dict[str, float]:
    """Instants in [0, 1] from warp_id, else from time_id, else from the order of the frames."""
    metadata = _read_json(path, "the frames' instants") if path.exists() else {}
    entries = [_value(path, metadata, name, dict) for name in names] if metadata else []
    key = next((key for key in ("warp_id", "time_id") if any(key in entry for entry in entries)), None)
    moments = np.array([_numbers(path, entry, key, ()) for entry in entries] if key else range(len(names)), float)
    span = np.ptp(moments) or 1.0
    return dict(zip(names, ((moments - moments.min()) / span).tolist(), strict=True))


def _normalization(folder: Path) -> tuple[Float64[np.ndarray, "3"], float]:
    """Center and scale of the scene."""
    path = folder / "scene.json"
    if not path.exists():
        return np.zeros(3), 1.0
    content = _read_json(path, "center and scale")
    scale = float(_numbers(path, content, "scale", ()))
    if scale <= 0:
        raise UserError(f"{path}: 'scale' is {scale}; expected a positive number")
    return _numbers(path, content, "center", (3,)), scale


def _points(folder: Path) -> tuple[Float64[np.ndarray, "P 3"], Float32[np.ndarray, "P 3"] | None]:
    """Points as stored, and their colours from a file of their own or from columns 4 to 6."""
    path = folder / "points.npy"
    rows = _read_array(path, "the scene's surface points, shape (P, 3)")
    if rows.ndim != 2 or rows.shape[1] not in (3, 6) or not len(rows):
        raise UserError(f"{path}: the array has shape {rows.shape}; expected (P, 3) or (P, 6) with at least one point")
    colors_path = folder / "points_rgb.npy"
    if colors_path.exists():
        colors = _read_array(colors_path, "the points' colours")
        if colors.shape != (len(rows), 3):
            raise UserError(f"{colors_path}: the array has shape {colors.shape}; expected {(len(rows), 3)}")
    elif rows.shape[1] == 6:
        colors_path, colors = path, rows[:, 3:]
    else:
        return rows.astype(np.float64), None
    if colors.min() < 0 or colors.max() > 255:
        raise UserError(f"{colors_path}: colours run from {colors.min()} to {colors.max()}; expected 0-1 or 0-255")
    unit = 255.0 if np.issubdtype(colors.dtype, np.integer) or colors.max() > 1 else 1.0
    return rows[:, :3].astype(np.float64), (colors / unit).astype(np.float32)


def _pictures(root: Path, downscale: int, names: list[str], optional: bool) -> list[Picture] | list[None]:
    """The picture of every frame, from the smallest stored size that a whole factor still shrinks to `downscale`."""
    if optional and not root.is_dir():
        return [None] * len(names)
    held = [match[1] for match in map(_SCALE.fullmatch, _listing(root)) if match]
    scale = max((int(factor) for factor in held if downscale % int(factor) == 0), default=0)
    if not scale:
        found = ", ".join(f"{factor}x" for factor in held) or "no folder like 1x"
        raise UserError(f"{root}: holds {found}; expected a factor that divides --downscale {downscale}")
    folder = root / f"{scale}x"
    files = {Path(file).stem: folder / file for file in _listing(folder) if Path(file).suffix.lower() in SUFFIXES}
    missing = [name for name in names if name not in files]
    if optional and len(missing) == len(names):
        return [None] * len(names)
    if missing:
        raise UserError(f"{folder / missing[0]}.png: no such file; expected the picture of frame '{missing[0]}'")
    return [Picture(files[name], scale) for name in names]


def _frame(
    path: Path,
    center: Float64[np.ndarray, "3"],
    scale: float,
    time: float,
    image: Picture,
    welllit: Picture | None,
    mask: Picture | None,
) -> Frame:
    """A frame from its camera file."""
    content = _read_json(path, f"the camera of frame '{path.stem}'")
    tangential = "tangential" if "tangential" in content else "tangential_distortion"  # the first is the older key
    optional = {"skew": 0.0, "pixel_aspect_ratio": 1.0, "radial_distortion": [0.0] * 3, tangential: [0.0] * 2}
    content = optional | content

    rotation = _numbers(path, content, "orientation", (3, 3))
    if not (np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0):
        raise UserError(f"{path}: 'orientation' is no rotation; expected an orthonormal matrix of determinant 1")
    position = (_numbers(path, content, "position", (3,)) - center) * scale
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position

    focal, aspect = (float(_numbers(path, content, key, ())) for key in ("focal_length", "pixel_aspect_ratio"))
    if focal <= 0 or aspect <= 0:
        raise UserError(
            f"{path}: 'focal_length' is {focal} and 'pixel_aspect_ratio' {aspect}; expected positive numbers"
        )
    skew = float(_numbers(path, content, "skew", ()))
    u, v = _numbers(path, content, "principal_point", (2,))
    k1, k2, k3 = _numbers(path, content, "radial_distortion", (3,))
    width, height = _numbers(path, content, "image_size", (2,))
    if min(width, height) < 1 or width % 1 or height % 1:
        raise UserError(f"{path}: 'image_size' is {width} by {height}; expected whole positive numbers of pixels")
    return Frame(
        name=path.stem,
        source=path,
        viewmat=viewmat,
        K=np.array([[focal, skew, u], [0, focal * aspect, v], [0, 0, 1]]),
        distortion=np.array([k1, k2, *_numbers(path, content, tangential, (2,)), k3]),
        size=(int(width), int(height)),
        time=time,
        image=image,
        welllit=welllit,
        mask=mask,
    )


def _listing(folder: Path) -> list[str]:
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; expected pictures in {folder / '1x'}")
    return sorted(entry.name for entry in folder.iterdir())


def _read_json(path: Path, what: str) -> dict[str, Any]:
    if not path.is_file():
        raise UserError(f"{path}: no such file; expected {what}")
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as JSON ({error}); expected {what}") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: holds a JSON {type(content).__name__}; expected an object with {what}")
    return content


def _read_array(path: Path, what: str) -> np.ndarray:
    if not path.is_file():
        raise UserError(f"{path}: no such file; expected {what}")
    try:
        values = np.load(path, allow_pickle=False)
        finite = np.isfinite(values).all()
    except (ValueError, EOFError, OSError, TypeError) as error:
        raise UserError(f"{path}: not a NumPy array of numbers ({error}); expected {what}") from None
    if not finite:
        raise UserError(f"{path}: holds NaN or infinite values; expected finite numbers")
    return values


def _value(path: Path, content: dict[str, Any], key: str, kind: type) -> Any:
    if key not in content:
        raise UserError(f"{path}: '{key}' is missing; expected a JSON {_JSON_NAMES[kind]}")
    if not isinstance(content[key], kind):
        raise UserError(f"{path}: '{key}' is {reprlib.repr(content[key])}; expected a JSON {_JSON_NAMES[kind]}")
    return content[key]


def _names(path: Path, content: dict[str, Any], key: str) -> list[str]:
    return [str(name) for name in _value(path, content, key, list)]


def _numbers(path: Path, content: dict[str, Any], key: str, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."]:
    """A finite array of that shape."""
    wanted = f"{'x'.join(map(str, shape))} numbers" if shape else "a number"
    if key not in content:
        raise UserError(f"{path}: '{key}' is missing; expected {wanted}")
    try:
        values = np.asarray(content[key], np.float64)
    except (TypeError, ValueError):
        values = np.array(np.nan)
    if values.shape != shape or not np.isfinite(values).all():
        raise UserError(f"{path}: '{key}' is {reprlib.repr(content[key])}; expected {wanted}, finite")
    return values
