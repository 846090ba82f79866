"""A video that is exactly known: a textured wall and a textured board before it, seen by a moving camera."""

from typing import NamedTuple

import cv2
import numpy as np

from l2dgs_jax.types import Camera

WIDTH, HEIGHT, FOCAL = 128, 96, 120.0
WALL, BOARD = 5.0, 3.5  # depths
HALF = 0.55  # half the board's side


class Video(NamedTuple):
    cameras: Camera
    images: np.ndarray
    truth: np.ndarray  # pixels that show the board
    points: np.ndarray


def video(motion=(0.0, 0.0), frames=8, shift=0.12, brightness=0.3, noise=0.01, seed=0) -> Video:
    """Film the scene.

    Args:
        motion: how far the board moves from one frame to the next, along x and y.
        frames: how many there are.
        shift: how far the camera moves along x from one frame to the next; it sways along y.
        brightness: factor on the colours.
        noise: standard deviation of the noise, before that factor.
        seed: of textures and noise.
    """
    rng = np.random.default_rng(seed)
    wall, board = texture(rng, 512), texture(rng, 192)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    index = np.arange(frames) - (frames - 1) / 2
    eyes = np.stack([shift * index, 0.1 * np.sin(index), 0 * index], -1)
    images, truth = [], []
    for eye, step in zip(eyes, index, strict=True):
        seen, _ = film(wall, K, eye, (0.0, 0.0), 4.0, WALL)
        near, inside = film(board, K, eye, step * np.array(motion), HALF, BOARD)
        image = np.where(inside[..., None] > 0.5, near, seen) + rng.normal(0, noise, seen.shape)
        images.append(np.clip(brightness * image, 0, 1))
        truth.append(inside > 0.5)
    viewmat = np.tile(np.eye(4), (frames, 1, 1))
    viewmat[:, :3, 3] = -eyes
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1.5, 1.5, 8), np.linspace(-1, 1, 8)))
    points = np.concatenate([np.stack([s * x, s * y, 0 * x + z], -1) for s, z in ((1, WALL), (0.3, BOARD))])
    cameras = Camera(viewmat, np.tile(K, (frames, 1, 1)), np.linspace(0, 1, frames))
    return Video(cameras, np.stack(images).astype(np.float16), np.stack(truth), points)


def texture(rng, size):
    octaves = [cv2.resize(rng.random((size // k, size // k, 3)), (size, size)) for k in (4, 8, 24)]
    return np.clip(0.5 + 1.2 * (np.mean(octaves, axis=0) - 0.5), 0, 1)


def film(picture, K, eye, centre, half, depth):
    """The picture as a square facing along z, and where it is seen."""
    size = len(picture)
    to_plane = np.array([[2 * half / size, 0, centre[0] - half], [0, 2 * half / size, centre[1] - half], [0, 0, 1.0]])
    place = np.array([[1, 0, -eye[0]], [0, 1, -eye[1]], [0, 0, depth - eye[2]]])
    centred = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV counts pixel centres from 0
    H = np.linalg.inv(centred) @ K @ place @ to_plane @ centred
    warp = lambda x: cv2.warpPerspective(x, H, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
    return warp(picture), warp(np.ones((size, size)))
