"""However a scene's JSON and binary files are damaged, loading succeeds or raises the project's own error."""

import functools
import json
import shutil

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scenes import write_nerfies

from l2dgs_jax import data
from l2dgs_jax.data import colmap_model
from l2dgs_jax.errors import UserError

FILES = {
    "nerfies": ["camera/000003.json", "dataset.json", "metadata.json", "scene.json", "points.npy", "points_rgb.npy"],
    "colmap": [f"sparse/0/{kind}{form}" for kind in ("cameras", "images", "points3D") for form in (".bin", ".txt")],
    "transforms": ["transforms.json", "points3D.ply"],
    "llff": ["poses_bounds.npy", "points3D.ply", "dataset.json", "metadata.json"],
}
VALUES = [None, True, -1, 0, 1e308, 10**400, 1e-320, "", "x", "\ud800", "\0", "../..", [], {}, [[]], [1, [2]], {"a": 1}]
WORDS = [b"nan", b"inf", b"-1", b"1e999", b"9" * 30, b'"', b"{", b"[" * 3000, b"\0", b"\xff\xfe", b"#", b"\n", b" "]


@functools.cache
def scene(base, layout):
    """A scene in the given layout; COLMAP's has its model as text as well."""
    source = base / "source"
    if not source.exists():
        write_nerfies(source, 6, 16, 12, num_points=12)
    folder = base / layout
    data.LAYOUTS[layout].write(data.load_dataset(source), folder)
    if layout == "colmap":
        write_text_model(folder / "sparse" / "0")
    return folder


def write_text_model(place):
    cameras, images = colmap_model.read_cameras(place), colmap_model.read_images(place)
    points, colors = colmap_model.read_points(place)
    lines = [f"{i} {c.model} {c.width} {c.height} {' '.join(map(str, c.params))}" for i, c in cameras.items()]
    (place / "cameras.txt").write_text("# cameras\n" + "\n".join(lines) + "\n")
    lines = [
        f"{i} 1 0 0 0 {' '.join(map(str, image.viewmat[:3, 3]))} {image.camera} {image.name}\n1 2 -1"
        for i, image in enumerate(images)
    ]
    (place / "images.txt").write_text("# images\n" + "\n".join(lines) + "\n")
    rows = [
        f"{i} {' '.join(map(str, p))} {' '.join(map(str, np.rint(255 * c).astype(int)))} 0.5"
        for i, (p, c) in enumerate(zip(points, colors, strict=True))
    ]
    (place / "points3D.txt").write_text("\n".join(rows) + "\n")


@st.composite
def damaged(draw, content, is_json):
    """The bytes of a file after one to four changes."""
    if is_json and draw(st.booleans()):
        return json.dumps(_replace(draw, json.loads(content))).encode()
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(content)))
        kind = draw(st.sampled_from(["cut", "flip", "insert", "drop", "word", "huge"]))
        if kind == "cut":
            content = content[:at]
        elif kind == "flip" and at < len(content):
            content = content[:at] + bytes([content[at] ^ (1 << draw(st.integers(0, 7)))]) + content[at + 1 :]
        elif kind == "insert":
            content = content[:at] + draw(st.binary(max_size=12)) + content[at:]
        elif kind == "drop":
            content = content[:at] + content[at + draw(st.integers(1, 40)) :]
        elif kind == "word":
            word = draw(st.sampled_from(WORDS))
            content = content[:at] + word + content[at + len(word) * draw(st.booleans()) :]
        else:
            content = content[:at] + b"\xff" * 8 + content[at + 8 :]
    return content


def _replace(draw, value):
    """The JSON value with one value inside it replaced or removed."""
    if isinstance(value, (dict, list)) and value and draw(st.integers(0, 3)):
        key = draw(st.sampled_from(sorted(value) if isinstance(value, dict) else range(len(value))))
        if isinstance(value, dict) and not draw(st.integers(0, 4)):
            return {k: v for k, v in value.items() if k != key}
        changed = _replace(draw, value[key])
        return value | {key: changed} if isinstance(value, dict) else [*value[:key], changed, *value[key + 1 :]]
    return draw(st.sampled_from(VALUES))


def error_message(folder):
    """The error message of loading a scene, or None."""
    try:
        data.load_dataset(folder)
    except UserError as error:
        return str(error)
    return None


def check(base, layout, file, examples):
    folder = scene(base, layout)
    path = folder / file
    original = path.read_bytes()
    hidden = path.with_suffix(".bin") if path.suffix == ".txt" else None
    if hidden:
        shutil.move(hidden, base / "hidden")
    data.load_dataset(folder)

    @settings(max_examples=examples, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(damaged(original, path.suffix == ".json"))
    def survives(content):
        path.write_bytes(content)
        message = error_message(folder)
        assert message is None or (message.count("\n") == 0 and "expected" in message)

    try:
        survives()
    finally:
        path.write_bytes(original)
        if hidden:
            shutil.move(base / "hidden", hidden)


CASES = [pytest.param(layout, file, id=f"{layout}-{file}") for layout, files in FILES.items() for file in files]


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize(("layout", "file"), CASES)
def test_a_damaged_file_gives_one_sentence_or_a_scene(base, layout, file):
    check(base, layout, file, 8)


@pytest.mark.slow
@pytest.mark.parametrize(("layout", "file"), CASES)
def test_thousands_of_damaged_files_give_one_sentence_or_a_scene(base, layout, file):
    check(base, layout, file, 150)
