"""A table seen from nearby: an arm stirs a bowl, and a hand pushes a box."""

import mitsuba as mi
import numpy as np

from experiments.makers.scenery import Parts, Pose, Scene, held, limb, paint

BOWL = np.array([0.08, 0.02, 0.0])
TURNS = 2.2  # of the spoon
BOOKS = (  # centre, half the sides, degrees
    ((-0.12, 0.42, 0.04), (0.14, 0.1, 0.04), 12),
    ((-0.1, 0.43, 0.1), (0.11, 0.09, 0.02), -20),
    ((0.42, 0.45, 0.12), (0.05, 0.1, 0.12), 25),
    ((-0.55, -0.1, 0.03), (0.06, 0.09, 0.03), 40),
)


def stir(time: float) -> Parts:
    """The spoon goes round; the box gathers speed."""
    skin = paint(22, [0.6, 0.4, 0.3], [0.78, 0.58, 0.47], (4, 4))
    sleeve = paint(20, [0.15, 0.2, 0.45], [0.5, 0.6, 0.8], (6, 8))
    wood = paint(24, [0.4, 0.25, 0.1], [0.7, 0.5, 0.3], (2, 6))
    angle = 2 * np.pi * TURNS * time
    cos, sin = np.cos(angle), np.sin(angle)
    tip = BOWL + np.array([0.05 * cos, 0.05 * sin, 0.05])
    hand = tip + np.array([0.03 + 0.01 * cos, -0.02, 0.15])
    wrist = hand + np.array([0.07, -0.04, 0.04])
    elbow = np.array([0.55 + 0.02 * cos, -0.25 + 0.02 * sin, 0.25])
    place = np.array([-0.45 + 0.3 * time - 0.04 * np.sin(6 * time), -0.2 + 0.03 * np.sin(5 * time), 0.04])
    fist = place + np.array([-0.07, -0.03, 0.01])
    joint, behind = place + np.array([-0.14, -0.09, 0.04]), place + np.array([-0.5, -0.35, 0.16])
    box = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate(place).rotate([0, 0, 1], 30 * time).scale([0.06, 0.04, 0.04]),
        "bsdf": paint(31, [0.1, 0.4, 0.15], [0.9, 0.85, 0.4], (4, 4)),
    }
    return (
        limb("spoon", [tip, hand + 0.25 * (hand - tip)], 0.008, wood)
        | limb("hand", [hand, wrist], 0.033, skin)
        | limb("finger", [hand + np.array([-0.01, 0.02, -0.02]), hand + np.array([0.03, 0.035, 0.0])], 0.013, skin)
        | limb("arm", [wrist, elbow, elbow + np.array([0.4, -0.2, 0.15])], 0.045, sleeve)
        | {"box": box}
        | limb("push", [fist, joint, behind], 0.03, skin)
    )


def near(time: float, offset: float) -> Pose:
    shake = 0.006 * np.array([np.sin(39 * time), np.sin(28 * time + 1), np.sin(52 * time + 2)])
    position = np.array([-0.15 + 0.35 * time, -1.15 + 0.1 * np.sin(4 * time), 0.75])
    return held(position, np.array([0.0, 0.08, 0.05]), shake, offset)


def table() -> Parts:
    """What stands still, and the lights."""
    T = mi.ScalarTransform4f
    mug, rim = np.array([-0.32, 0.2, 0.0]), np.array([-0.32, 0.2, 0.12])
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [55.0, 48.0, 37.0]}}
    parts: Parts = {
        "table": {
            "type": "rectangle",
            "to_world": T().scale([1.2, 0.8, 1]),
            "bsdf": paint(1, [0.35, 0.3, 0.25], [0.75, 0.7, 0.6], (14, 14)),
        },
        "wall": {
            "type": "rectangle",
            "to_world": T().translate([0, 0.85, 0.5]).rotate([1, 0, 0], 90).scale([2.5, 1.5, 1]),
            "bsdf": paint(2, [0.2, 0.3, 0.25], [0.5, 0.6, 0.5], (16, 10)),
        },
        "mug": {
            "type": "cylinder",
            "p0": mug,
            "p1": rim,
            "radius": 0.045,
            "bsdf": paint(3, [0.5, 0.1, 0.1], [0.9, 0.6, 0.3], (4, 4)),
        },
        "coffee": {
            "type": "disk",
            "to_world": T().translate(rim).scale(0.045),
            "bsdf": paint(4, [0.1, 0.05, 0.02], [0.3, 0.2, 0.1], (3, 3)),
        },
        "bowl": {
            "type": "cylinder",
            "p0": BOWL,
            "p1": BOWL + np.array([0, 0, 0.07]),
            "radius": 0.11,
            "bsdf": paint(5, [0.1, 0.2, 0.4], [0.4, 0.6, 0.8], (8, 3)),
        },
        "soup": {
            "type": "disk",
            "to_world": T().translate(BOWL + np.array([0, 0, 0.055])).scale(0.108),
            "bsdf": paint(6, [0.4, 0.25, 0.05], [0.8, 0.55, 0.2], (5, 5)),
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.52, 0.58]}},
        "lamp": {"type": "sphere", "center": [0.9, -1.0, 1.9], "radius": 0.12, "emitter": lamp},
    }
    for k, (center, sides, turn) in enumerate(BOOKS):
        parts[f"book{k}"] = {
            "type": "cube",
            "to_world": T().translate(center).rotate([0, 0, 1], turn).scale(sides),
            "bsdf": paint(10 + k, [0.3, 0.1, 0.1 + 0.1 * k], [0.8, 0.6, 0.35 + 0.1 * k]),
        }
    return parts


TABLE = Scene(table, stir, near, baseline=0.15)
