"""Rendered clips of a textured scene with known cameras, for the tests of `prepare`."""

import functools

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL = 240, 180, 220.0


@functools.cache
def noise_texture(size: int = 1024) -> np.ndarray:
    """Blobs of all sizes, values in [0, 1]."""
    rng = np.random.default_rng(0)
    layers = [cv2.GaussianBlur(rng.random((size, size, 3), np.float32), (0, 0), sigma) for sigma in (1.0, 3, 8)]
    mixed = sum((layer - layer.mean()) / layer.std() for layer in layers)
    return np.clip(0.5 + 0.14 * mixed, 0, 1)


def camera(place: float) -> np.ndarray:
    """World to camera at `place` in [-1, 1] of an arc; looks at the middle of the scene."""
    eye = np.array([1.6 * place, -0.5 + 0.3 * place**2, -3.5 + 0.4 * place**2])
    forward = np.array([0, 0, 1.0]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross([0, 1, 0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return np.block([[rotation, (-rotation @ eye)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def render(viewmat: np.ndarray, block: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A room's back wall, its floor, and a board; with `block`, a textured square at that height before them.

    Returns:
        The picture [H W 3] in [0, 1], and True where the square is.
    """
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([columns / FOCAL, rows / FOCAL, np.ones_like(rows)], -1) @ viewmat[:3, :3]
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    picture, nearest = np.zeros((HEIGHT, WIDTH, 3), np.float32), np.full((HEIGHT, WIDTH), np.inf)
    square = np.zeros((HEIGHT, WIDTH), bool)
    # (axis of the normal, offset, centre and half size across the two other axes)
    surfaces = [(2, 2.0, (0, 0), 9.0), (1, 1.0, (0, 0), 9.0), (2, 0.6, (0.7, 0.3), 0.6)]
    if block is not None:
        surfaces.append((2, -0.5, (-0.3, block), 0.35))
    for i, (axis, offset, middle, half) in enumerate(surfaces):
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (offset - eye[axis]) / rays[..., axis]
            where = np.delete(eye + distance[..., None] * rays, axis, -1) - middle
        hit = (distance > 0) & (distance < nearest) & (np.abs(where) < half).all(-1)
        pixels = np.nan_to_num(where * 60 + 512, posinf=0, neginf=0).astype(np.float32)
        texture = np.roll(noise_texture(), 200 * i, axis=(0, 1))
        seen = cv2.remap(texture, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        picture[hit], nearest[hit] = seen[hit], distance[hit]
        square = hit if i == 3 else square & ~hit
    return picture, square


def clip(count: int, *, reach: float = 1.0, light: float = 1.0, block: bool = True) -> tuple[list, list, list]:
    """Pictures, cameras, and where the moving square is.

    Args:
        count: frames.
        reach: part of the arc that the camera moves along; 0 stands still.
        light: factor on the colours, to which a sensor's noise is added.
        block: whether there is a moving square.
    """
    rng = np.random.default_rng(0)
    views = [camera(reach * (2 * i / max(count - 1, 1) - 1)) for i in range(count)]
    drawn = [render(view, 0.5 - 1.2 * i / max(count - 1, 1) if block else None) for i, view in enumerate(views)]
    pictures = [np.clip(light * p + rng.normal(0, 0.004, p.shape), 0, 1).astype(np.float32) for p, _ in drawn]
    return pictures, views, [square for _, square in drawn]


def through_lens(picture: np.ndarray, k1: float) -> np.ndarray:
    """The picture that a lens of radial distortion `k1` takes."""
    K = np.array([[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1]])
    pixels = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).reshape(-1, 1, 2).astype(np.float32)
    straight = cv2.undistortPoints(pixels, K, np.array([k1, 0, 0, 0]), P=K).reshape(HEIGHT, WIDTH, 2)
    return cv2.remap(picture, straight, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT).clip(0, 1)


def write_video(path, pictures, codec: str = "FFV1") -> None:
    """Write 8-bit RGB pictures at 25 frames a second."""
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 25, (width, height))
    for picture in pictures:
        writer.write(picture[..., ::-1])
    writer.release()
