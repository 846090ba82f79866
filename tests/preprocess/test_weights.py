"""Weights of the curve network on disk: ours, PyTorch's, and those that are neither."""

import jax
import numpy as np
import pytest
from torch_files import saved

from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.lowlight import curve_network, weights

WIDTH = 3


def network(width=WIDTH):
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(lambda: curve_network.init(jax.random.key(0), width))
    return jax.tree.map(lambda leaf: jax.numpy.asarray(rng.normal(size=leaf.shape), np.float32), shapes)


def released(net, dtype=np.float32):
    """The state_dict that PyTorch would save of a network."""
    names = [f"e_conv_e{i}" for i in range(1, 5)] + [f"e_conv{i}" for i in range(1, 8)]
    state = {}
    for name, conv in zip(names, (*net.exposure, *net.image), strict=True):
        state[f"{name}.weight"] = np.ascontiguousarray(np.transpose(conv.weight, (3, 2, 0, 1)), dtype)
        state[f"{name}.bias"] = np.asarray(conv.bias, dtype)
    return state


def assert_same(a, b, **tolerance):
    for left, right in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert left.dtype == np.float32
        np.testing.assert_allclose(left, right, **tolerance)


@pytest.mark.parametrize("legacy", [False, True], ids=["zip", "legacy"])
@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
def test_files_of_pytorch_are_read(tmp_path, legacy, dtype):
    path = tmp_path / "ce_zerodce.pth"
    path.write_bytes(saved(released(network(), dtype), legacy=legacy))
    assert_same(weights.load(path), network(), rtol=1e-3 if dtype == "float16" else 1e-7, atol=1e-6)


def test_saved_weights_come_back(tmp_path):
    weights.save(tmp_path / "mine.npz", network())
    assert_same(weights.load(tmp_path / "mine.npz"), network(), rtol=0)


def test_shipped_weights_are_small():
    assert weights.SHIPPED.stat().st_size < 300_000
    assert len(jax.tree.leaves(weights.load())) == 22


def changed(**changes):
    state = {**released(network()), **changes}
    return {name: array for name, array in state.items() if array is not None}


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({}, "holds no array 'e_conv1.bias'"),
        ({"weight": np.zeros(3, np.float32)}, "holds no array 'e_conv1.bias'"),
        (changed(**{"e_conv1.bias": np.zeros((3, 1), np.float32)}), "holds no array 'e_conv1.bias'"),
        (changed(**{"e_conv_e3.weight": None}), "'e_conv_e3.weight' is missing"),
        (changed(**{"e_conv7.bias": np.zeros(24, np.float32)}), r"'e_conv7.bias' has shape \(24,\)"),
        (changed(**{"e_conv5.weight": np.zeros((3, 6, 3, 3), np.float32)}), r"expected \(3, 9, 3, 3\)"),
        (changed(**{"e_conv2.bias": np.zeros(3, np.int64)}), "type int64; expected"),
        (changed(**{"e_conv2.bias": np.full(3, np.nan, np.float32)}), "'e_conv2.bias' .* finite"),
    ],
    ids=["empty", "another network", "another rank", "missing", "Zero-DCE", "narrower", "integers", "NaN"],
)
@pytest.mark.parametrize("suffix", [".npz", ".pth"])
def test_other_networks_are_refused(tmp_path, suffix, state, message):
    path = tmp_path / f"other{suffix}"
    if suffix == ".npz":
        np.savez(path, **state)
    else:
        path.write_bytes(saved(state, legacy=False))
    with pytest.raises(UserError, match=message) as caught:
        weights.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "expected" in str(caught.value)


def test_damaged_and_missing_files_are_refused(tmp_path):
    intact = tmp_path / "whole.npz"
    weights.save(intact, network())
    content = intact.read_bytes()
    for kept in (0, 30, len(content) // 2, len(content) - 10):
        (tmp_path / "cut.npz").write_bytes(content[:kept])
        with pytest.raises(UserError, match=r"cut.npz: .* expected weights of a curve network"):
            weights.load(tmp_path / "cut.npz")
    with pytest.raises(UserError, match=r"nonsuch.npz: cannot be read"):
        weights.load(tmp_path / "nonsuch.npz")
