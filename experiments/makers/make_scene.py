"""Path-trace a scene whose truth is known: `python -m experiments.makers.make_scene OUTPUT [--scene NAME]`.

Before a camera held by hand somebody walks through a yard while a ball rolls ("walk"), somebody comes nearer while a
bag swings on a rope ("approach"), two people meet behind a ball that bounces ("crowd"), or, on a table, an arm stirs a
bowl and a hand pushes a box ("table"); a second camera, beside the first, is held out. The scene has the layout of
Nerfies, with masks of what moves and points on static surfaces, as structure from motion finds them. It is well lit:
`python -m l2dgs_jax.simulate` makes it dark.

Needs Mitsuba 3 (`pip install mitsuba`). `--variant llvm_ad_rgb` takes half the time, and LLVM 17 or newer.
"""

import argparse
from pathlib import Path
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
from jaxtyping import Bool, Float64
from tqdm import tqdm

from experiments.makers import tabletop, yard
from experiments.makers.scenery import Vector
from l2dgs_jax.data import nerfies
from l2dgs_jax.data.color import linear_to_srgb
from l2dgs_jax.data.dataset import Dataset, Split
from l2dgs_jax.runtime.files import new_folder
from l2dgs_jax.types import Camera

WIDTH, HEIGHT, FOCAL = 400, 225, 400.0  # pixels
SAMPLES = 128  # a pixel
EVERY = 3  # the held-out camera sees every third instant
POINTS, POINT_NOISE = 4000, 0.003  # the noise is a fraction of the distance

SCENES = {"walk": yard.WALK, "approach": yard.APPROACH, "crowd": yard.CROWD, "table": tabletop.TABLE}

Image = Float64[np.ndarray, "H W 3"]
Mask = Bool[np.ndarray, "H W"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--scene", default="walk", choices=SCENES)
    parser.add_argument("--frames", type=int, default=48)
    parser.add_argument("--variant", default="scalar_rgb", choices=mi.variants())
    options = parser.parse_args()
    mi.set_variant(options.variant)
    with new_folder(options.output) as folder:  # which refuses before it takes minutes, not after
        nerfies.write(make(options.scene, options.frames), folder)


def make(name: str, frames: int) -> Dataset:
    """The scene of that name, well lit."""
    stand, move, film, baseline = SCENES[name]
    rng = np.random.default_rng(0)
    points = []
    views: dict[float, list[tuple[str, Camera, Image, Mask]]] = {0.0: [], baseline: []}  # by the camera's offset
    static = stand()
    for i, time in enumerate(tqdm(np.linspace(0, 1, frames))):
        scenes = [mi.load_dict({"type": "scene"} | parts) for parts in (static, static | move(time))]
        for offset, seen in views.items():
            if offset and i % EVERY:
                continue
            position, rotation = film(time, offset)
            image = render(scenes[1], position, rotation, {"type": "path", "max_depth": 6}, SAMPLES)
            image = linear_to_srgb(np.clip(image, 0, 1))
            behind, hits = (render(x, position, rotation, {"type": "aov", "aovs": "p:position"}, 1) for x in scenes)
            moves = (behind != hits).any(-1)
            frame = f"{i:06d}_r" if offset else f"{i:06d}"
            seen.append((frame, pinhole(position, rotation, time), image, moves))
            if not offset:
                points.append(corners(image, hits, moves, position, -(-POINTS // frames), rng))
    train, test = (_split(*zip(*seen, strict=True)) for seen in views.values())
    return Dataset(name, WIDTH, HEIGHT, train, test, np.concatenate(points).astype(np.float32))


def _split(
    names: tuple[str, ...], cameras: tuple[Camera, ...], images: tuple[Image, ...], masks: tuple[Mask, ...]
) -> Split:
    stacked = Camera(*(np.array(values, np.float32) for values in zip(*cameras, strict=True)))
    return Split(names, stacked, np.stack(images), masks=np.stack(masks))


def pinhole(position: Vector, rotation: Float64[np.ndarray, "3 3"], time: float) -> Camera:
    """A camera at an instant, as the package describes it."""
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    return Camera(viewmat, np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]), np.float64(time))


def render(
    scene: Any, position: Vector, rotation: Float64[np.ndarray, "3 3"], integrator: dict[str, Any], samples: int
) -> Image:
    """What an integrator finds at each pixel; the same pixels' rays in every scene."""
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    sensor = {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(WIDTH / 2 / FOCAL))),
        "to_world": mi.ScalarTransform4f().look_at(position, position + rotation[2], [0, 0, 1]),
        "film": film,
    }
    picture = mi.render(scene, sensor=mi.load_dict(sensor), integrator=mi.load_dict(integrator), spp=samples)
    return np.asarray(picture, np.float64)[..., :3]


def corners(
    image: Image, hits: Image, moves: Mask, position: Vector, count: int, rng: np.random.Generator
) -> Float64[np.ndarray, "N 3"]:
    """Points that a camera sees on static surfaces, the more where there is texture, off along their rays."""
    grey = image.mean(-1)
    texture = np.hypot(cv2.Sobel(grey, -1, 1, 0), cv2.Sobel(grey, -1, 0, 1))
    texture[moves | (hits == 0).all(-1)] = 0
    chosen = rng.choice(texture.size, count, replace=False, p=(texture / texture.sum()).ravel())
    noise = 1 + POINT_NOISE * rng.standard_normal((count, 1))
    return position + noise * (hits.reshape(-1, 3)[chosen] - position)


if __name__ == "__main__":
    main()
