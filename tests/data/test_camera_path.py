"""nerfstudio's camera_path.json."""

import json

import numpy as np
import pytest
from scenes import write_json

from l2dgs_jax.data.camera_path import read_camera_path
from l2dgs_jax.errors import UserError

SIZE = (64, 48)
POSE = [1.0, 0, 0, 3, 0, 0, -1, 4, 0, 1, 0, 5, 0, 0, 0, 1]  # at (3, 4, 5); up is z, back is -y: it looks along +y


def entry(**changes):
    values = {"camera_to_world": POSE, "fov": 90, "aspect": 1.5} | changes
    return {key: value for key, value in values.items() if value != "left out"}


def write(path, entries, **changes):
    write_json(path, {"camera_type": "perspective", "camera_path": entries} | changes)
    return path


def test_cameras_are_converted_to_opencv_axes(tmp_path):
    found = read_camera_path(write(tmp_path / "a.json", [entry(), entry(fov=60)]), SIZE)
    assert found.size == SIZE
    assert found.fps is None
    assert all(x.dtype == np.float32 for x in found.cameras)
    ahead = found.cameras.viewmat[0] @ [3, 6, 5, 1]
    np.testing.assert_allclose(ahead, [0, 0, 2, 1], atol=1e-6)
    above = found.cameras.viewmat[0] @ [3, 6, 6, 1]
    np.testing.assert_allclose(above, [0, -1, 2, 1], atol=1e-6)
    right = found.cameras.viewmat[0] @ [4, 6, 5, 1]
    np.testing.assert_allclose(right, [1, 0, 2, 1], atol=1e-6)


def test_the_field_of_view_is_vertical(tmp_path):
    path = write(tmp_path / "a.json", [entry(), entry(fov=60)], render_width=200, render_height=100, fps=30)
    found = read_camera_path(path, SIZE)
    assert (found.size, found.fps) == ((200, 100), 30)
    np.testing.assert_allclose(found.cameras.K[0], [[50, 0, 100], [0, 50, 50], [0, 0, 1]], rtol=1e-6)
    np.testing.assert_allclose(found.cameras.K[1, 1, 1], 50 * np.sqrt(3), rtol=1e-6)


@pytest.mark.parametrize("key", ["render_time", "time"])
def test_instants_are_those_of_the_file_or_evenly_spaced(tmp_path, key):
    other = {"render_time": "time", "time": "render_time"}[key]
    timed = write(tmp_path / "a.json", [entry(**{other: None, key: t}) for t in (0.5, 0, 1)])
    np.testing.assert_allclose(read_camera_path(timed, SIZE).cameras.time, [0.5, 0, 1])
    plain = write(tmp_path / "b.json", [entry(), entry(**{key: None}), entry()])
    np.testing.assert_allclose(read_camera_path(plain, SIZE).cameras.time, [0, 0.5, 1])


@pytest.mark.parametrize(
    ("entries", "changes", "message"),
    [
        ([], {}, "'camera_path' is no list of cameras; expected at least one"),
        ([7], {}, "'camera_path' is no list of cameras; expected at least one"),
        (None, {}, "'camera_path' is None; expected a JSON array"),
        ([entry()], {"camera_type": "equirectangular"}, "'camera_type' is 'equirectangular'; expected 'perspective'"),
        ([entry()], {"render_width": 64}, "'render_height' is missing; expected a number"),
        ([entry()], {"render_width": "wide", "render_height": 4}, "'render_width' is 'wide'; expected a number"),
        ([entry(), entry(fov="left out")], {}, "camera 2 of 2: 'fov' is missing; expected a number"),
        ([entry(fov=180)], {}, "camera 1 of 1: 'fov' is 180; expected degrees between 0 and 180"),
        ([entry(camera_to_world=POSE[:12])], {}, "expected 16 numbers"),
        ([entry(camera_to_world=[2 * x for x in POSE])], {}, "'camera_to_world' is not a rotation"),
        ([entry(camera_to_world=[*POSE[:15], 2.0])], {}, "the last row of 'camera_to_world'"),
        ([entry(time=0.0), entry(time=1.5)], {}, "camera 2 of 2: 'time' is 1.5; expected an instant from 0 to 1"),
        ([entry(render_time=-0.1)], {}, "'render_time' is -0.1; expected an instant from 0 to 1"),
        ([entry(time=0.2), entry()], {}, "camera 2 of 2: 'render_time' is missing; expected a number"),
        ([entry()], {"fps": "fast"}, "'fps' is 'fast'; expected a number"),
    ],
)
def test_mistakes_are_reported_in_one_sentence(tmp_path, entries, changes, message):
    path = write(tmp_path / "path.json", entries, **changes)
    with pytest.raises(UserError) as error:
        read_camera_path(path, SIZE)
    assert message in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe", json.dumps("path").encode()])
def test_a_file_of_another_kind_is_reported_in_one_sentence(tmp_path, content):
    path = tmp_path / "path.json"
    path.write_bytes(content)
    with pytest.raises(UserError, match="nerfstudio's camera path"):
        read_camera_path(path, SIZE)
