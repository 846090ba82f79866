"""A yard, through which people walk."""

from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from experiments.makers.scenery import Parts, Pose, Scene, Vector, held, limb, paint

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
BASELINE = 0.5  # metres between the two cameras


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
    return held(position, np.array([0.3 * time, 0.6, 0.63]), shake, offset)


def forward(time: float, offset: float) -> Pose:
    shake = 0.02 * np.array([np.sin(37 * time + 0.3), np.sin(31 * time + 2), np.sin(47 * time)])
    return held(np.array([0.5 - 0.5 * time, -4.6 + 0.7 * time, 1.45]), np.array([-0.1, 0.6, 0.8]), shake, offset)


def around(time: float, offset: float) -> Pose:
    shake = 0.015 * np.array([np.sin(43 * time), np.sin(27 * time + 1), np.sin(51 * time + 2)])
    angle = 0.7 * time - 0.35
    position = np.array([4.6 * np.sin(angle), 0.3 - 4.6 * np.cos(angle), 1.5])
    return held(position, np.array([0, 0.3, 0.75]), shake, offset)


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


WALK = Scene(yard, walk, sideways, BASELINE)
APPROACH = Scene(yard, approach, forward, BASELINE)
CROWD = Scene(yard, crowd, around, BASELINE)
