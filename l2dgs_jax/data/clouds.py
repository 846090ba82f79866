"""Initial points for scenes whose layout has none: from a PLY file beside them, or else random."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64, Shaped

from l2dgs_jax.cameras.geometry import camera_centres
from l2dgs_jax.errors import UserError

RANDOM_POINTS = 10_000  # in a random cloud
CLOUD_FILES = ("points3D.ply", "points3d.ply", "sparse_pc.ply")
# Half the side of the box of random points, over the cameras' distance from its centre: 1.3 / 4, as usual for D-NeRF.
BOX_OVER_DISTANCE = 0.325

Cloud = tuple[Float[np.ndarray, "P 3"], Float32[np.ndarray, "P 3"] | None]

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
_TYPES |= {"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"float32": "f4", "float64": "f8"}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


def find(folder: Path, named: str | None = None) -> Cloud | None:
    """The cloud in a PLY file of the scene: the one that it names, or else one of `CLOUD_FILES`, if there is one.

    Raises:
        UserError: the file is missing or damaged.
    """
    for path in (folder / named,) if named else (folder / name for name in CLOUD_FILES):
        if named or path.is_file():
            return read_ply(path)
    return None


def in_common_box(viewmats: Float64[np.ndarray, "F 4 4"], source: str) -> Float64[np.ndarray, "P 3"]:
    """Random points in a box around the place that all cameras look at.

    Raises:
        UserError: the cameras look at no common place.
    """
    centres = camera_centres(viewmats)
    axes = viewmats[:, 2, :3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # projections onto the planes normal to the axes
    total = across.sum(0)
    if not np.linalg.cond(total) < 1e4:
        raise UserError(
            f"{source}: the cameras look at no common place; expected a point cloud such as {CLOUD_FILES[0]}"
        )
    centre = np.linalg.solve(total, np.einsum("fij,fj->i", across, centres))
    half = BOX_OVER_DISTANCE * np.median(np.linalg.norm(centres - centre, axis=-1))
    return centre + half * np.random.default_rng(0).uniform(-1, 1, (RANDOM_POINTS, 3))


def in_frusta(
    viewmats: Float64[np.ndarray, "F 4 4"],
    Ks: Float64[np.ndarray, "F 3 3"],
    size: tuple[int, int],
    bounds: Float64[np.ndarray, "F 2"],
) -> Float64[np.ndarray, "P 3"]:
    """Random points, each in the view of some camera between that camera's nearest and farthest depth."""
    rng = np.random.default_rng(0)
    frames = rng.integers(0, len(viewmats), RANDOM_POINTS)
    pixels = np.concatenate([rng.uniform(0, size, (RANDOM_POINTS, 2)), np.ones((RANDOM_POINTS, 1))], -1)
    near, far = bounds[frames].T
    depth = near + (far - near) * rng.random(RANDOM_POINTS)
    local = np.einsum("pij,pj->pi", np.linalg.inv(Ks)[frames], pixels) * depth[:, None]
    worlds = np.linalg.inv(viewmats)[frames]
    return np.einsum("pij,pj->pi", worlds[:, :3, :3], local) + worlds[:, :3, 3]


def read_ply(path: Path) -> Cloud:
    """The vertices of a PLY file, and their sRGB colours in [0, 1] if it has some.

    Raises:
        UserError: the file is missing or damaged, or its vertices have no position.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file; expected the scene's points")
    data = path.read_bytes()
    head, found, body = data.partition(b"end_header")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    try:
        rows = _vertices(lines, body.partition(b"\n")[2])
        points = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], -1)
    except (ValueError, KeyError, IndexError, TypeError, OverflowError) as error:
        raise UserError(f"{path}: not a PLY file of points ({error}); expected vertices with x, y, z") from None
    if not found or not len(points) or not np.isfinite(points).all():
        raise UserError(f"{path}: holds no points or some that are not finite; expected a cloud of finite points")
    if not {"red", "green", "blue"} <= set(rows.dtype.names or ()):
        return points, None
    colors = np.stack([rows[name] for name in ("red", "green", "blue")], -1)
    unit = 255 if colors.dtype.kind in "iu" else 1
    if not (colors.min() >= 0 and colors.max() <= unit):
        raise UserError(f"{path}: has colours out of range; expected 0-255, or 0-1 for floating-point numbers")
    return points, (colors / unit).astype(np.float32)


def write_ply(path: Path, points: Float[np.ndarray, "P 3"], colors: Float[np.ndarray, "P 3"] | None) -> None:
    """Write points in single precision and 8-bit colours."""
    path.write_bytes(encode_ply(colored_points(points, colors)))


def colored_points(
    points: Float[np.ndarray, "P 3"], colors: Float[np.ndarray, "P 3"] | None
) -> Shaped[np.ndarray, " P"]:
    """The rows of a PLY file of points, with positions in single precision and 8-bit colours."""
    kind = [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue") if colors is not None]
    rows = np.empty(len(points), kind)
    for i, axis in enumerate("xyz"):
        rows[axis] = points[:, i]
    if colors is not None:
        for i, name in enumerate(("red", "green", "blue")):
            rows[name] = np.rint(255 * colors[:, i])
    return rows


def encode_ply(vertices: Shaped[np.ndarray, " P"]) -> bytes:
    """A binary PLY file of vertices, whose fields are little-endian floats or bytes."""
    names = {"<f4": "float", "|u1": "uchar"}
    fields = [(name, vertices.dtype[name].str) for name in vertices.dtype.names or ()]
    properties = "".join(f"property {names[form]} {name}\n" for name, form in fields)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}end_header\n"
    return head.encode() + vertices.tobytes()


def _vertices(lines: Sequence[Sequence[str]], body: bytes) -> Shaped[np.ndarray, " P"]:
    """The rows of the first element, which must be the vertices.

    Raises:
        ValueError, KeyError, IndexError, TypeError: the header is malformed, or the body too short.
        OverflowError: the header tells of more vertices than a file can hold.
    """
    if not lines or lines[0] != ["ply"]:
        raise ValueError("it does not begin with 'ply'")
    orders = [_ORDERS[words[1]] for words in lines if words[:1] == ["format"]]
    elements = [i for i, words in enumerate(lines) if words[:1] == ["element"]]
    first = lines[elements[0]]
    if first[1] != "vertex":
        raise ValueError(f"its first element is '{first[1]}'")
    count = int(first[2])
    until = elements[1] if len(elements) > 1 else len(lines)
    properties = [words for words in lines[elements[0] : until] if words[:1] == ["property"]]
    order = orders[0]
    kind = np.dtype([(words[2], order + _TYPES[words[1]]) for words in properties])
    if order != "=":
        return np.frombuffer(body, kind, count)
    values = np.array(body.split()[: count * len(properties)], np.float64).reshape(count, len(properties))
    return np.rec.fromarrays(list(values.T), dtype=kind)
