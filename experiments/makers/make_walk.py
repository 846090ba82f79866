"""Path-trace a scene whose truth is known: `python -m experiments.makers.make_walk OUTPUT [--scene NAME] [--frames N]`.

Before a hand-held camera in a yard, somebody walks past while a ball rolls ("walk"), somebody comes nearer while a bag
swings on a rope ("approach"), or two people meet behind a ball that bounces ("crowd"); a second camera, beside the
first, is held out. The scene has the layout of Nerfies, with masks of what moves and points on static surfaces, as
structure from motion finds them. It is well lit: `python -m l2dgs_jax.simulate` makes it dark.

Needs Mitsuba 3 (`pip install mitsuba`). `--variant llvm_ad_rgb` takes half the time, and LLVM 17 or newer.
"""

import argparse
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import mitsuba as mi
import numpy as np
from jaxtyping import Bool, Float64
from tqdm import tqdm

from l2dgs_jax.data import nerfies
from l2dgs_jax.data.color import linear_to_srgb
from l2dgs_jax.data.dataset import Dataset, Split
from l2dgs_jax.runtime.files import new_folder
from l2dgs_jax.types import Camera

WIDTH, HEIGHT, FOCAL = 400, 225, 400.0  # pixels
SAMPLES = 128  # a pixel
BASELINE = 0.5  # metres between the two cameras
EVERY = 3  # the held-out camera sees every third instant
POINTS, POINT_NOISE = 4000, 0.003  # the noise is a fraction of the distance

WAY = 2.8  # metres that a walk is long
STRIDE = 1.3  # metres that a step of both legs covers
LEG, LEG_RADIUS = (0.43, 0.42), 0.075  # lengths from hip to knee and to ankle
SIDES = {-1: "left", 1: "right"}
BALL = 0.17  # its radius
CRATES = (  # x, y and z of the centre, half the side, degrees
    (-0.7, 1.7, 0.3, 0.3, 20),
    (-0.65, 1.75, 0.8, 0.2, 50),
    (0.5, 1.9, 0.35, 0.35, -10),
    (1.6, -1.2, 0.2, 0.2, 35),
    (-2.2, -0.9, 0.25, 0.25, 15),
)

Vector = Float64[np.ndarray, "3"]
Image = Float64[np.ndarray, "H W 3"]
Mask = Bool[np.ndarray, "H W"]
Parts = dict[str, dict[str, Any]]
Pose = tuple[Vector, Float64[np.ndarray, "3 3"]]  # position and axes, in rows, of a camera


class Scene(NamedTuple):
    """What a camera films; all depends on the time, from 0 to 1.

    Attributes:
        film: the camera, or another one so many metres to its right that sees the same.
        move: what moves.
    """

    film: Callable[[float, float], Pose]
    move: Callable[[float], Parts]


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
    film, move = SCENES[name]
    rng = np.random.default_rng(0)
    points = []
    views: dict[float, list[tuple[str, Camera, Image, Mask]]] = {0.0: [], BASELINE: []}  # by the camera's offset
    static = yard()
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


def walk(time: float) -> Parts:
    """Somebody walks past, and a ball rolls in front."""
    way, heading = 2.0 * time, np.array([np.cos(0.15), -np.sin(0.15), 0.0])
    center = np.array([-0.8, -0.2, BALL]) + way * heading
    turn = mi.ScalarTransform4f().rotate(np.cross([0.0, 0.0, 1.0], heading), np.degrees(way / BALL))
    return walker(time, (-1.5, 0.3), (1, 0)) | {"ball": ball(center, turn)}


def approach(time: float) -> Parts:
    """Somebody comes nearer, and a bag swings on a rope."""
    angle = 0.5 * np.sin(2 * np.pi * (1.3 * time + 0.1))
    top = np.array([-1.0, 0.4, 2.6])
    bag = top + 1.7 * np.array([np.sin(angle), 0.3 * np.sin(angle), -np.cos(angle)])
    cloth = paint(31, [0.1, 0.25, 0.1], [0.8, 0.8, 0.3], (4, 4))
    return walker(time, (1.2, 1.7), (-0.55, -0.83)) | {
        "rope": {"type": "cylinder", "p0": top, "p1": bag, "radius": 0.02, "bsdf": cloth},
        "bag": {"type": "sphere", "center": bag, "radius": 0.2, "bsdf": cloth},
    }


def crowd(time: float) -> Parts:
    """Two people walk past each other, and a ball bounces in front."""
    center = np.array([1.2 - 1.9 * time, -1.2, BALL + 0.5 * abs(np.sin(3 * np.pi * time))])
    near, far = walker(time, (-1.5, -0.4), (1, 0.05)), walker(0.8 * time + 0.05, (1.9, 1.0), (-1, -0.1))
    people = {f"near{k}": part for k, part in near.items()} | {f"far{k}": part for k, part in far.items()}
    return people | {"ball": ball(center, mi.ScalarTransform4f())}


def sideways(time: float, offset: float) -> Pose:
    shake = 0.02 * np.array([np.sin(41 * time), np.sin(29 * time + 1), np.sin(53 * time + 2)])
    position = np.array([-0.7 + 1.1 * time, -4.2 + 0.5 * np.sin(3 * time), 1.65])
    return _held(position, np.array([0.3 * time, 0.6, 0.63]), shake, offset)


def forward(time: float, offset: float) -> Pose:
    shake = 0.02 * np.array([np.sin(37 * time + 0.3), np.sin(31 * time + 2), np.sin(47 * time)])
    return _held(np.array([0.5 - 0.5 * time, -4.6 + 0.7 * time, 1.45]), np.array([-0.1, 0.6, 0.8]), shake, offset)


def around(time: float, offset: float) -> Pose:
    shake = 0.015 * np.array([np.sin(43 * time), np.sin(27 * time + 1), np.sin(51 * time + 2)])
    angle = 0.7 * time - 0.35
    position = np.array([4.6 * np.sin(angle), 0.3 - 4.6 * np.cos(angle), 1.5])
    return _held(position, np.array([0, 0.3, 0.75]), shake, offset)


def _held(position: Vector, target: Vector, shake: Vector, offset: float) -> Pose:
    """A camera that shakes while it looks at a target, or another one to its right."""
    position, target = position + shake, target + shake[::-1]
    position = position + offset * _axes(target - position)[0]
    return position, _axes(target - position)


def _axes(forward: Vector) -> Float64[np.ndarray, "3 3"]:
    """Right, down and forward of a camera that is held upright."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


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


def paint(seed: int, low: list[float], high: list[float], cells: tuple[int, int] = (8, 8)) -> dict[str, Any]:
    """A matt surface between two colours: patches of the given number, in finer and finer detail."""
    rng = np.random.default_rng(seed)
    size = (256, 256)
    layers = [
        cv2.resize(rng.uniform(size=(2**k * cells[1], 2**k * cells[0])), size, interpolation=cv2.INTER_NEAREST)
        for k in range(4)
    ]
    mix = np.average(layers, axis=0, weights=[4, 2, 1, 1])[..., None]
    mix = np.clip(0.5 + 2 * (mix - 0.5), 0, 1)
    bitmap = mi.Bitmap((mix * np.array(high) + (1 - mix) * np.array(low)).astype(np.float32))
    return {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap, "raw": True}}


def yard() -> Parts:
    """What stands still, and the lights."""
    T = mi.ScalarTransform4f
    ground = paint(1, [0.16, 0.15, 0.13], [0.5, 0.47, 0.42], (20, 20))
    bricks = paint(2, [0.25, 0.1, 0.07], [0.62, 0.4, 0.3], (16, 24))
    wood = paint(3, [0.2, 0.12, 0.05], [0.55, 0.38, 0.2], (3, 10))
    metal = paint(4, [0.1, 0.2, 0.3], [0.3, 0.5, 0.65])
    plant = paint(5, [0.05, 0.15, 0.04], [0.3, 0.55, 0.2])
    parts: Parts = {
        "ground": {"type": "rectangle", "to_world": T().scale([7, 7, 1]), "bsdf": ground},
        "wall": {
            "type": "rectangle",
            "to_world": T().translate([0, 2.6, 1.2]).rotate([1, 0, 0], 90).scale([7, 2.2, 1]),
            "bsdf": bricks,
        },
        "side": {
            "type": "rectangle",
            "to_world": T().translate([-3.4, 0, 1.2]).rotate([0, 1, 0], 90).scale([2.2, 7, 1]),
            "bsdf": paint(6, [0.5, 0.45, 0.3], [0.75, 0.7, 0.55]),
        },
        "door": {"type": "cube", "to_world": T().translate([1.5, 2.58, 1]).scale([0.5, 0.05, 1]), "bsdf": wood},
        "barrel": {"type": "cylinder", "p0": [-1.9, 1.5, 0], "p1": [-1.9, 1.5, 0.9], "radius": 0.33, "bsdf": metal},
        "lid": {"type": "disk", "to_world": T().translate([-1.9, 1.5, 0.9]).scale(0.33), "bsdf": wood},
        "bush": {"type": "sphere", "center": [2.3, 1.6, 0.45], "radius": 0.5, "bsdf": plant},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.55, 0.68]}},
        "lamp": {
            "type": "sphere",
            "center": [2.5, -2.5, 4.2],
            "radius": 0.35,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [40.0, 35.0, 27.0]}},
        },
    }
    for k, (x, y, z, size, turn) in enumerate(CRATES):
        parts[f"crate{k}"] = {
            "type": "cube",
            "to_world": T().translate([x, y, z]).rotate([0, 0, 1], turn).scale(size),
            "bsdf": paint(10 + k, [0.3, 0.2, 0.1], [0.7, 0.55, 0.35]),
        }
    return parts


def limb(name: str, joints: Sequence[Vector], radius: float, bsdf: dict[str, Any]) -> Parts:
    """Rounded rods from joint to joint."""
    parts: Parts = {
        f"{name}{i}": {"type": "sphere", "center": p, "radius": radius, "bsdf": bsdf} for i, p in enumerate(joints)
    }
    for i, (p, q) in enumerate(itertools.pairwise(joints)):
        parts[f"{name}rod{i}"] = {"type": "cylinder", "p0": p, "p1": q, "radius": radius, "bsdf": bsdf}
    return parts


def walker(time: float, start: tuple[float, float], heading: tuple[float, float]) -> Parts:
    """Somebody who swings arms and legs, one foot on the ground."""
    shirt = paint(20, [0.6, 0.1, 0.1], [0.85, 0.6, 0.3], (6, 6))
    trousers = paint(21, [0.05, 0.07, 0.2], [0.2, 0.25, 0.5], (4, 8))
    skin = paint(22, [0.6, 0.4, 0.3], [0.75, 0.55, 0.45], (3, 3))
    hair = paint(23, [0.1, 0.06, 0.03], [0.3, 0.2, 0.1])
    phase = 2 * np.pi * WAY * time / STRIDE
    ahead = np.array([*heading, 0.0]) / np.linalg.norm(heading)
    aside = np.cross([0.0, 0.0, 1.0], ahead)
    legs = {}
    for side in SIDES:
        thigh = 0.45 * side * np.sin(phase)
        legs[side] = [thigh, thigh - 0.1 - 0.6 * max(0.0, side * np.cos(phase))]
    height = LEG_RADIUS + max(np.dot(LEG, np.cos(angles)) for angles in legs.values())
    hip = np.array([*start, height]) + WAY * time * ahead

    def body(x: float, y: float, z: float) -> Vector:
        return hip + x * ahead + y * aside + np.array([0.0, 0.0, z])

    def reach(start: Vector, lengths: Sequence[float], angles: Sequence[float]) -> list[Vector]:
        joints = [start]
        for length, angle in zip(lengths, angles, strict=True):
            joints.append(joints[-1] + length * (np.sin(angle) * ahead - np.array([0.0, 0.0, np.cos(angle)])))
        return joints

    parts = limb("trunk", [body(0, 0, 0.05), body(0.02, 0, 0.45)], 0.17, shirt)
    parts |= limb("head", [body(0.03, 0, 0.76)], 0.12, skin) | limb("hair", [body(0, 0, 0.81)], 0.115, hair)
    for side, name in SIDES.items():
        parts |= limb(f"{name}leg", reach(body(0, 0.1 * side, 0), LEG, legs[side]), LEG_RADIUS, trousers)
        arm = -0.5 * side * np.sin(phase)
        parts |= limb(f"{name}arm", reach(body(0, 0.24 * side, 0.46), [0.29, 0.27], [arm, arm + 0.5]), 0.055, shirt)
    return parts


def ball(center: Vector, turn: Any) -> dict[str, Any]:
    colours = paint(30, [0.1, 0.3, 0.7], [0.95, 0.9, 0.2], (4, 3))
    placed = mi.ScalarTransform4f().translate(center) @ turn @ mi.ScalarTransform4f().scale(BALL)
    return {"type": "sphere", "to_world": placed, "bsdf": colours}


SCENES = {"walk": Scene(sideways, walk), "approach": Scene(forward, approach), "crowd": Scene(around, crowd)}


if __name__ == "__main__":
    main()
