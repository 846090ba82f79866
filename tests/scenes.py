"""Tiny scenes on disk for the tests."""

import json
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio  # noqa: N813

GAIN = 4.0  # well-lit over low-light value


def write_nerfies(
    path: Path,
    num_frames: int = 8,
    width: int = 32,
    height: int = 24,
    *,
    val_every: int | None = 4,
    truth: bool = False,
    colors: bool = True,
    num_points: int = 60,
    center: tuple[float, float, float] = (0.5, -0.25, 1.0),
    scale: float = 0.5,
    seed: int = 0,
    **camera: object,
) -> Path:
    """Write a Nerfies scene of coloured blobs, one of which moves, before a camera on an arc; returns `path`.

    Args:
        path: folder to create.
        num_frames: frames in all.
        width: of the images.
        height: of the images.
        val_every: every how many frames one is held out; None leaves `val_ids` empty.
        truth: also write well-lit images and masks of the moving blob.
        colors: also write `points_rgb.npy`.
        num_points: surface points.
        center: of `scene.json`; the files hold world coordinates before it is applied.
        scale: of `scene.json`.
        seed: of blobs and points.
        **camera: keys of the camera files that replace the usual values.
    """
    rng = np.random.default_rng(seed)
    places = rng.uniform(-1, 1, (num_points, 3))
    paint = rng.uniform(0.2, 1, (num_points, 3))
    names = [f"{i:06d}" for i in range(num_frames)]
    for i, name in enumerate(names):
        angle = 0.4 * (2 * i / max(num_frames - 1, 1) - 1)
        eye = np.array([4 * np.sin(angle), 0.2, -4 * np.cos(angle)])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross([0, 1, 0], forward) / np.linalg.norm(np.cross([0, 1, 0], forward))
        rotation = np.stack([right, np.cross(forward, right), forward])
        values = {
            "orientation": rotation.tolist(),
            "position": (eye / scale + np.array(center)).tolist(),
            "focal_length": 1.2 * width,
            "principal_point": [width / 2, height / 2],
            "skew": 0.0,
            "pixel_aspect_ratio": 1.0,
            "radial_distortion": [0.0, 0.0, 0.0],
            "tangential_distortion": [0.0, 0.0],
            "image_size": [width, height],
        }
        write_json(path / "camera" / f"{name}.json", values | camera)

        moved = places.copy()
        moved[0] = [1.5 * i / max(num_frames - 1, 1) - 0.75, 0, -1]
        local = (moved - eye) @ rotation.T
        pixels = 1.2 * width * local[:, :2] / local[:, 2:] + [width / 2, height / 2]
        image, mask = np.full((height, width, 3), 0.4), np.zeros((height, width))
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        for j in np.argsort(-local[:, 2]):
            near = np.exp(-((columns - pixels[j, 0]) ** 2 + (rows - pixels[j, 1]) ** 2) / (0.004 * width**2))
            image += near[..., None] * (paint[j] - image)
            mask = np.maximum(mask * (near < 0.5), (near >= 0.5) * (j == 0))
        write_image(path / "rgb" / "1x" / f"{name}.png", image / GAIN)
        if truth:
            write_image(path / "well" / "1x" / f"{name}.png", image)
            write_image(path / "mask" / "1x" / f"{name}.png", mask)

    val = names[val_every // 2 :: val_every] if val_every else []
    lists = {"count": num_frames, "ids": names, "train_ids": [n for n in names if n not in val], "val_ids": val}
    write_json(path / "dataset.json", lists)
    write_json(path / "metadata.json", {name: {"warp_id": i} for i, name in enumerate(names)})
    write_json(path / "scene.json", {"center": list(center), "scale": scale, "near": 0.1, "far": 10.0})
    np.save(path / "points.npy", (places / scale + np.array(center)).astype(np.float32))
    if colors:
        np.save(path / "points_rgb.npy", np.rint(paint * 255 / GAIN).astype(np.uint8))
    return path


def write_image(path: Path, image: np.ndarray) -> None:
    """Write grey, RGB or RGBA values: floats in [0, 1] with 8 bits, integers as they are."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.rint(255 * image).astype(np.uint8) if image.dtype.kind == "f" else image
    if image.ndim == 3:
        pixels = pixels[..., [2, 1, 0, 3][: image.shape[-1]]]
    assert cv2.imwrite(str(path), pixels)


def write_json(path: Path, content: object) -> None:
    """Write a JSON file and the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def edit_json(path: Path, **changes: object) -> None:
    """Replace top-level keys of a JSON file; None removes one."""
    content = {**json.loads(path.read_text()), **changes}
    write_json(path, {key: value for key, value in content.items() if value is not None})


def mark_orientation(path: Path, orientation: int) -> None:
    """Give a picture EXIF's orientation, and leave its pixels."""
    pixels = oiio.ImageBuf(str(path))
    pixels.specmod().attribute("Orientation", orientation)
    assert pixels.write(str(path))
