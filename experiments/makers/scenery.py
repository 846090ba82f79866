"""What scenes to path-trace consist of: things, their paint, and cameras held by hand."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import cv2
import mitsuba as mi
import numpy as np
from jaxtyping import Float64

Vector = Float64[np.ndarray, "3"]
Parts = dict[str, dict[str, Any]]
Pose = tuple[Vector, Float64[np.ndarray, "3 3"]]  # position and axes, in rows, of a camera


class Scene(NamedTuple):
    """What a camera films; all but what stands still depends on the time, from 0 to 1.

    Attributes:
        stand: what stands still, and the lights.
        move: what moves.
        film: the camera, or another one so many metres to its right that sees the same.
        baseline: metres between the two cameras.
    """

    stand: Callable[[], Parts]
    move: Callable[[float], Parts]
    film: Callable[[float, float], Pose]
    baseline: float


def held(position: Vector, target: Vector, shake: Vector, offset: float) -> Pose:
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


def limb(name: str, joints: Sequence[Vector], radius: float, bsdf: dict[str, Any]) -> Parts:
    """Rounded rods from joint to joint."""
    parts: Parts = {
        f"{name}{i}": {"type": "sphere", "center": p, "radius": radius, "bsdf": bsdf} for i, p in enumerate(joints)
    }
    for i, (p, q) in enumerate(itertools.pairwise(joints)):
        parts[f"{name}rod{i}"] = {"type": "cylinder", "p0": p, "p1": q, "radius": radius, "bsdf": bsdf}
    return parts
