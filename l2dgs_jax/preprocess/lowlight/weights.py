"""Weights of the curve network on disk: those of this package, those that a user has trained, and LEDNet's release."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.lowlight import curve_network
from l2dgs_jax.runtime.arrays import expect_floats
from l2dgs_jax.runtime.arrays import load as load_arrays
from l2dgs_jax.runtime.files import replacing
from l2dgs_jax.types import Conv

SHIPPED = Path(__file__).parent / "darkener.npz"
_LAYERS = tuple(f"e_conv{name}" for name in ("_e1", "_e2", "_e3", "_e4", 1, 2, 3, 4, 5, 6, 7))


def load(path: Path = SHIPPED) -> curve_network.CurveNet:
    """Read the parameters of a network of any width.

    Both kinds of file hold the arrays of the released `ce_zerodce.pth`: a `.weight` in OIHW order and a `.bias` each of
    e_conv_e1 ... e_conv_e4 and e_conv1 ... e_conv7.

    Args:
        path: an .npz as `save` writes it, or a state_dict as torch.save writes it.

    Raises:
        UserError: the file is missing, damaged, or of another network.
    """
    arrays = load_arrays(path, "weights of a curve network")
    layers = f"the layers {_LAYERS[0]} ... {_LAYERS[-1]}"
    for name, shape in _shapes(_width(path, arrays)).items():
        expect_floats(path, arrays, name, shape, layers)
    convs = [
        Conv(_kernel(arrays[f"{layer}.weight"]), jnp.asarray(arrays[f"{layer}.bias"], jnp.float32)) for layer in _LAYERS
    ]
    return curve_network.CurveNet(tuple(convs[:4]), tuple(convs[4:]))


def save(path: Path, net: curve_network.CurveNet) -> None:
    """Write parameters as an .npz for `load`.

    Raises:
        UserError: the file cannot be written.
    """
    arrays = {}
    for layer, conv in zip(_LAYERS, (*net.exposure, *net.image), strict=True):
        arrays[f"{layer}.weight"] = np.asarray(conv.weight, np.float32).transpose(3, 2, 0, 1)
        arrays[f"{layer}.bias"] = np.asarray(conv.bias, np.float32)
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def _width(path: Path, arrays: dict[str, Shaped[np.ndarray, "..."]]) -> int:
    first = arrays.get("e_conv1.bias")
    if first is None or first.ndim != 1 or not first.size:
        raise UserError(f"{path}: holds no array 'e_conv1.bias'; expected weights of ConditionZeroDCE")
    return len(first)


def _shapes(width: int) -> dict[str, tuple[int, ...]]:
    like = jax.eval_shape(lambda: curve_network.init(jax.random.key(0), width))
    shapes: dict[str, tuple[int, ...]] = {}
    for layer, conv in zip(_LAYERS, (*like.exposure, *like.image), strict=True):
        rows, columns, inputs, outputs = conv.weight.shape
        shapes |= {f"{layer}.weight": (outputs, inputs, rows, columns), f"{layer}.bias": conv.bias.shape}
    return shapes


def _kernel(weight: Shaped[np.ndarray, "O I k k"]) -> jax.Array:
    return jnp.asarray(weight.transpose(2, 3, 1, 0), jnp.float32)
