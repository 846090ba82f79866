"""Every format of splats, read back according to its specification."""

import json
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2dgs_jax.data import clouds
from l2dgs_jax.exporters import antimatter15, gltf, ply
from l2dgs_jax.exporters.splats import Splats, visible

SH_C0 = 0.28209479177387814


@pytest.fixture
def splats():
    """Splats of all sizes, some with opacities, colours and scales at the ends of their ranges."""
    rng = np.random.default_rng(0)
    count = 50
    quats = rng.normal(size=(count, 4))
    arrays = (
        rng.normal(size=(count, 3)),
        quats / np.linalg.norm(quats, axis=-1, keepdims=True),
        np.exp(rng.normal(-3, 1, (count, 3))),
        rng.uniform(0.05, 1, count),
        rng.uniform(0, 1, (count, 3)),
    )
    splats = Splats(*(array.astype(np.float32) for array in arrays))
    splats.opacities[:2] = 0, 1
    splats.colors[:3] = [[0], [1], [1.2]]
    splats.scales[2, 0] = 0
    return splats


def test_a_ply_file_holds_raw_values_under_the_usual_names(splats):
    head, _, body = ply.encode(splats).partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 50"]
    names = [line.removeprefix("property float ") for line in lines[3:]]
    usual = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    assert names == [*usual, "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    rows = np.frombuffer(body, "<f4").reshape(50, 17)
    assert np.isfinite(rows).all()
    np.testing.assert_array_equal(rows[:, :3], splats.means)
    np.testing.assert_array_equal(rows[:, 3:6], 0)
    np.testing.assert_allclose(0.5 + SH_C0 * rows[:, 6:9], splats.colors, atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-rows[:, 9])), splats.opacities, atol=2e-6)
    np.testing.assert_allclose(np.exp(rows[:, 10:13]), splats.scales, rtol=1e-5, atol=2e-6)
    np.testing.assert_array_equal(rows[:, 13:], splats.quats)


def test_a_splat_file_has_32_bytes_a_gaussian_and_the_most_prominent_first(splats):
    data = antimatter15.encode(splats)
    assert len(data) == 32 * 50
    floats = np.frombuffer(data, "<f4").reshape(50, 8)[:, :6]
    levels = np.frombuffer(data, np.uint8).reshape(50, 32)[:, 24:]
    prominence = floats[:, 3:].astype(float).prod(-1) * levels[:, 3] / 255
    assert (np.diff(prominence) <= 0.002 * prominence[:-1] + 1e-9).all()
    indices = {tuple(mean): i for i, mean in enumerate(splats.means.tolist())}
    order = [indices[tuple(mean)] for mean in floats[:, :3].tolist()]
    assert sorted(order) == list(range(50))
    np.testing.assert_array_equal(floats[:, 3:], splats.scales[order])
    np.testing.assert_allclose(levels[:, :3] / 255, np.minimum(splats.colors, 1)[order], atol=0.51 / 255)
    np.testing.assert_allclose(levels[:, 3] / 255, splats.opacities[order], atol=0.51 / 255)
    np.testing.assert_allclose((levels[:, 4:] - 128.0) / 128, splats.quats[order], atol=1.01 / 128)


def read_glb(data):
    """The JSON and the arrays of the only primitive, by attribute."""
    magic, version, length, json_length, json_kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, json_kind) == (b"glTF", 2, len(data), b"JSON")
    content = json.loads(data[20 : 20 + json_length])
    binary_length, binary_kind = struct.unpack("<I4s", data[20 + json_length : 28 + json_length])
    assert binary_kind == b"BIN\0"
    assert json_length % 4 == binary_length % 4 == 0
    binary = data[28 + json_length :]
    assert len(binary) == binary_length == content["buffers"][0]["byteLength"]
    (primitive,) = content["meshes"][0]["primitives"]
    arrays = {}
    for name, index in primitive["attributes"].items():
        accessor = content["accessors"][index]
        view = content["bufferViews"][accessor["bufferView"]]
        assert accessor["componentType"] == 5126
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert view["byteLength"] == 4 * width * accessor["count"]
        part = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        arrays[name] = np.frombuffer(part, "<f4").reshape(accessor["count"], width)
    low, high = (content["accessors"][primitive["attributes"]["POSITION"]][end] for end in ("min", "max"))
    np.testing.assert_array_equal([low, high], [arrays["POSITION"].min(0), arrays["POSITION"].max(0)])
    return content, primitive, arrays


def test_a_gltf_file_follows_the_extension(splats):
    content, primitive, arrays = read_glb(gltf.encode(splats, np.array([0.0, 1.0, 0.0])))
    assert content["asset"]["version"] == "2.0"
    assert content["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
    }
    extension = {name.partition(":")[2]: array for name, array in arrays.items() if ":" in name}
    assert set(extension) == {"ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"}
    np.testing.assert_array_equal(arrays["POSITION"], splats.means)
    np.testing.assert_array_equal(extension["ROTATION"][:, [3, 0, 1, 2]], splats.quats)
    np.testing.assert_array_equal(extension["SCALE"], splats.scales)
    np.testing.assert_array_equal(extension["OPACITY"][:, 0], splats.opacities)
    np.testing.assert_allclose(0.5 + SH_C0 * extension["SH_DEGREE_0_COEF_0"], splats.colors, atol=1e-6)
    # Points for programs that do not know the extension: linear light.
    np.testing.assert_allclose(arrays["COLOR_0"][:2], [[0, 0, 0, 0], [1, 1, 1, 1]], atol=1e-6)
    np.testing.assert_allclose(arrays["COLOR_0"][:, :3], np.minimum(splats.colors, 1) ** 2.2, atol=0.01)


@pytest.mark.parametrize("up", [(0, 1, 0), (0, -1, 0), (0, 0, 1), (0.3, -0.9, 0.2)])
def test_a_gltf_scene_stands_upright(splats, up):
    content, _, _ = read_glb(gltf.encode(splats, np.array(up, float)))
    turn = Rotation.from_quat(content["nodes"][0]["rotation"])
    np.testing.assert_allclose(turn.apply(up) / np.linalg.norm(up), [0, 1, 0], atol=1e-6)


def test_a_cloud_is_a_ply_file_of_coloured_points(splats, tmp_path):
    (tmp_path / "cloud.ply").write_bytes(ply.encode_cloud(splats))
    points, colors = clouds.read_ply(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(points, splats.means)
    np.testing.assert_allclose(colors, np.minimum(splats.colors, 1), atol=0.51 / 255)


def test_splats_too_faint_to_be_seen_are_left_out(splats):
    splats.opacities[:4] = 0, 0.9 / 255, 1.1 / 255, 1
    shown = visible(splats)
    np.testing.assert_array_equal(shown.means, splats.means[2:])
    np.testing.assert_array_equal(shown.colors, splats.colors[2:])
