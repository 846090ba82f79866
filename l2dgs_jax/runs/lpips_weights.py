"""Weights of LPIPS, which do not come with the package, from files of the user."""

import re
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.metrics import NETWORKS, Lpips, Network
from l2dgs_jax.runtime.arrays import expect_floats, load
from l2dgs_jax.types import Conv

# torchvision and the package lpips name the same layers differently; the latter's heads come alone or with the network.
_TRUNK = re.compile(r"(?:features|net\.slice\d)\.(\d+)\.(weight|bias)")
_HEAD = re.compile(r"lin(?:s\.)?(\d)\.model\.1\.weight")


def load_lpips(network: Network, paths: Sequence[Path]) -> Lpips:
    """Read the weights of a network, in one file or in several that complete each other.

    The arrays have the names and shapes that they have in PyTorch: `features.N.weight` (OIHW) and `.bias` of the
    convolutions, or `net.sliceK.N.weight` and `.bias`; and of the heads `linK.model.1.weight`, [1 C 1 1].

    Args:
        network: whose weights they are.
        paths: .npz files, or state_dicts as torch.save writes them.

    Raises:
        UserError: a file cannot be read, or weights are missing or of another network.
    """
    arrays = {}
    for path in paths:
        for name, array in load(path, f"weights of LPIPS ({network})").items():
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


def _single(array: Shaped[np.ndarray, "..."]) -> jnp.ndarray:
    return jnp.asarray(array, jnp.float32)
