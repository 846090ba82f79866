"""LPIPS (arXiv 1801.03924, version 0.1): distance of two images in the features of an image-recognition network."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from l2dgs_jax.types import Conv

Network = Literal["alex", "vgg"]
Images = Float[Array, "B H W C"]

_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of values in [-1, 1]


class Layer(NamedTuple):
    """A convolution with ReLU.

    Attributes:
        place: its index in torchvision's `features`.
        size: of the kernel.
        inputs: number of input channels.
        outputs: number of output channels.
        stride: pixels.
        padding: pixels of zeros around the image.
        pool: window of the max pooling with stride 2 before it; 0 for none.
        compared: whether LPIPS compares its outputs.
    """

    place: int
    size: int
    inputs: int
    outputs: int
    stride: int = 1
    padding: int = 1
    pool: int = 0
    compared: bool = True


NETWORKS: dict[Network, tuple[Layer, ...]] = {
    "alex": (
        Layer(0, 11, 3, 64, stride=4, padding=2),
        Layer(3, 5, 64, 192, padding=2, pool=3),
        Layer(6, 3, 192, 384, pool=3),
        Layer(8, 3, 384, 256),
        Layer(10, 3, 256, 256),
    ),
    "vgg": (
        Layer(0, 3, 3, 64, compared=False),
        Layer(2, 3, 64, 64),
        Layer(5, 3, 64, 128, pool=2, compared=False),
        Layer(7, 3, 128, 128),
        Layer(10, 3, 128, 256, pool=2, compared=False),
        Layer(12, 3, 256, 256, compared=False),
        Layer(14, 3, 256, 256),
        Layer(17, 3, 256, 512, pool=2, compared=False),
        Layer(19, 3, 512, 512, compared=False),
        Layer(21, 3, 512, 512),
        Layer(24, 3, 512, 512, pool=2, compared=False),
        Layer(26, 3, 512, 512, compared=False),
        Layer(28, 3, 512, 512),
    ),
}
SMALLEST_SIDE: dict[Network, int] = {"alex": 31, "vgg": 16}  # of an image, pixels, for the last layer to have outputs


class Lpips(NamedTuple):
    """Weights of a network.

    Attributes:
        convs: of its layers.
        heads: weights of the channels of those layers that are compared.
    """

    convs: tuple[Conv, ...]
    heads: tuple[Float[Array, " C"], ...]


def lpips_maps(
    network: Network, weights: Lpips, a: Float[Array, "H W 3"], b: Float[Array, "H W 3"]
) -> list[Float[Array, "_ _"]]:
    """For each compared layer, a map of the differences of its outputs; LPIPS is the sum of the maps' means.

    Args:
        network: which one.
        weights: of `NETWORKS[network]`.
        a: image with values in [0, 1], which are scaled to the [-1, 1] that LPIPS was made for.
        b: image with values in [0, 1].
    """
    x = (2 * jnp.stack([a, b]) - 1 - _row(_SHIFT, a)) / _row(_SCALE, a)
    maps, heads = [], iter(weights.heads)
    for layer, conv in zip(NETWORKS[network], weights.convs, strict=True):
        x = jax.nn.relu(_convolved(_pooled(x, layer.pool) if layer.pool else x, layer, conv))
        if layer.compared:
            first, second = x / (jnp.linalg.norm(x, axis=-1, keepdims=True) + 1e-10)
            maps.append(jnp.matmul((first - second) ** 2, next(heads).astype(x.dtype), precision="highest"))
    return maps


def _convolved(x: Images, layer: Layer, conv: Conv) -> Float[Array, "B h w O"]:
    stride, around = (layer.stride,) * 2, [(layer.padding,) * 2] * 2
    order = ("NHWC", "HWIO", "NHWC")
    weight = conv.weight.astype(x.dtype)
    product = jax.lax.conv_general_dilated(x, weight, stride, around, dimension_numbers=order, precision="highest")
    return product + _row(conv.bias, x)


def _pooled(x: Images, window: int) -> Float[Array, "B h w C"]:
    return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, window, window, 1), (1, 2, 2, 1), "VALID")


def _row(channels: Sequence[float] | Float[Array, " C"], like: Float[Array, "..."]) -> Float[Array, "1 1 1 C"]:
    return jnp.asarray(channels, like.dtype).reshape(1, 1, 1, -1)
