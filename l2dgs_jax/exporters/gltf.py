"""Binary glTF 2.0 with the extension KHR_gaussian_splatting, as the Khronos Group ratified it."""

import json
import struct
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from l2dgs_jax.data.color import srgb_to_linear
from l2dgs_jax.exporters.splats import Splats, sh_coefficients

EXTENSION = "KHR_gaussian_splatting"
UP = (0.0, 1.0, 0.0)  # in glTF
FLOAT, POINTS, ARRAY_BUFFER = 5126, 0, 34962
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def encode(splats: Splats, up: Float[np.ndarray, "3"]) -> bytes:
    """Content of a .glb file with one node, which rotates the scene so that `up` becomes +Y; its data are not rotated.

    Values are activated, and rotations are xyzw. Programs without the extension show points of the same colours.

    Args:
        splats: the Gaussians, at least one.
        up: direction in the world, any norm.
    """
    attributes = {
        "POSITION": splats.means,
        "COLOR_0": np.column_stack([srgb_to_linear(splats.colors.clip(0, 1)), splats.opacities]),
        f"{EXTENSION}:ROTATION": np.roll(splats.quats, -1, axis=-1),
        f"{EXTENSION}:SCALE": splats.scales,
        f"{EXTENSION}:OPACITY": splats.opacities[:, None],
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": sh_coefficients(splats.colors),
    }
    arrays = [np.ascontiguousarray(array, "<f4") for array in attributes.values()]
    offsets = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    accessors: list[dict[str, Any]] = [
        {"bufferView": i, "componentType": FLOAT, "count": len(array), "type": TYPES[array.shape[1]]}
        for i, array in enumerate(arrays)
    ]
    accessors[0] |= {"min": arrays[0].min(0).tolist(), "max": arrays[0].max(0).tolist()}  # required for positions
    primitive = {
        "mode": POINTS,
        "attributes": {name: i for i, name in enumerate(attributes)},
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    turn, _ = Rotation.align_vectors([UP], [up])
    content = {
        "asset": {"version": "2.0", "generator": "l2dgs_jax"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": turn.as_quat().tolist()}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": ARRAY_BUFFER}
            for offset, array in zip(offsets, arrays, strict=False)
        ],
        "buffers": [{"byteLength": offsets[-1]}],
    }
    return _binary(json.dumps(content).encode(), b"".join(array.tobytes() for array in arrays))


def _binary(text: bytes, data: bytes) -> bytes:
    """The container: a header and two chunks, each padded to a multiple of 4 bytes."""
    text += b" " * (-len(text) % 4)
    chunks = [struct.pack("<I4s", len(part), kind) + part for kind, part in ((b"JSON", text), (b"BIN\0", data))]
    body = b"".join(chunks)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
