"""Exposure-conditioned Zero-DCE: per-pixel darkening curves for a target exposure, learned without reference images.

The network and its curve are those with which LEDNet (arXiv 2202.03373) simulates low light: Zero-DCE (arXiv
2001.06826) with its curve reversed and a second branch that sees the exposure. How its authors trained it is not
published; the losses here are ours. The width can be chosen; the released network has 256 channels.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from l2dgs_jax.model.networks import apply_conv, init_conv
from l2dgs_jax.training import optimizer
from l2dgs_jax.training.losses import block_means
from l2dgs_jax.types import Conv

ITERATIONS = 10  # of the curve
# With Zero-DCE's smoothness weight of 200, the network learns to equalise local tone, and edges get halos.
EXPOSURE_WEIGHT, SPATIAL_WEIGHT, SMOOTHNESS_WEIGHT = 10.0, 1.0, 1000.0
BLOCK = 4  # side of the blocks that the spatial loss averages over, pixels

Scalar = Float[Array, ""]
Net = TypeVar("Net")
Batch = TypeVar("Batch", bound=tuple)


class CurveNet(NamedTuple):
    """Parameters: 3x3 convolutions of the branch that sees the exposure, and of the one that sees the lightness.

    Attributes:
        exposure: four layers, 1 -> C -> C -> C -> C channels.
        image: seven layers; the last three also read earlier outputs of both branches, and the last returns the curves.
    """

    exposure: tuple[Conv, ...]
    image: tuple[Conv, ...]


def init(key: PRNGKeyArray, width: int) -> CurveNet:
    """Xavier-uniform kernels, zero biases.

    Args:
        key: random key of the kernels.
        width: channels C of every hidden layer.
    """
    keys = iter(jax.random.split(key, 11))

    def layers(*sizes: tuple[int, int]) -> tuple[Conv, ...]:
        return tuple(init_conv(next(keys), 3, inputs, outputs) for inputs, outputs in sizes)

    first = ((1, width), *((width, width),) * 3)
    last = ((3 * width, width), (3 * width, width), (3 * width, ITERATIONS))
    return CurveNet(layers(*first), layers(*first, *last))


def curves(
    net: CurveNet, lightness: Float[Array, "*B H W"], exposure: Float[Array, "*B H W"]
) -> Float[Array, "*B H W 10"]:
    """The curve parameters of every pixel, in [-1, 1]. Gradients flow to all arguments.

    Args:
        net: parameters.
        lightness: in [0, 1].
        exposure: target lightness around each pixel, in [0, 1].
    """

    def relu_conv(layer: Conv, *features: Float[Array, "B H W _"]) -> Float[Array, "B H W C"]:
        return jax.nn.relu(apply_conv(layer, jnp.concatenate(features, -1)))

    e, x = ([plane.reshape(-1, *plane.shape[-2:], 1)] for plane in (exposure, lightness))
    for layer in net.exposure:
        e.append(relu_conv(layer, e[-1]))
    for layer in net.image[:4]:
        x.append(relu_conv(layer, x[-1]))
    x5 = relu_conv(net.image[4], e[4], x[3], x[4])
    x6 = relu_conv(net.image[5], e[3], x[2], x5)
    raw = apply_conv(net.image[6], jnp.concatenate([e[2], x[1], x6], -1))
    return jnp.tanh(raw).reshape(*lightness.shape, ITERATIONS)


def iterate(lightness: Float[Array, "*B"], curves: Float[Array, "*B R"]) -> Float[Array, "*B"]:
    """Apply x <- x + r (x^2 - x) once for every r in `curves`; r > 0 darkens, and x stays in [0, 1] for |r| <= 1.

    Gradients flow to both arguments.
    """
    for n in range(curves.shape[-1]):
        lightness = lightness + curves[..., n] * (lightness * lightness - lightness)
    return lightness


def loss(net: CurveNet, lightness: Float[Array, "B H W"], exposure: Float[Array, "B H W"]) -> Scalar:
    """The reference-free objective over a batch of images; gradients flow to `net`.

    The target exposure applies to each image as a whole: applied to every block, as in Zero-DCE, it flattens all tone.
    """
    r = curves(net, lightness, exposure)
    dark = iterate(lightness, r)
    return (
        EXPOSURE_WEIGHT * exposure_loss(dark, exposure)
        + SPATIAL_WEIGHT * spatial_loss(dark, lightness)
        + SMOOTHNESS_WEIGHT * smoothness_loss(r)
    )


def exposure_loss(dark: Float[Array, "B H W"], exposure: Float[Array, "B H W"]) -> Scalar:
    """Mean absolute difference between the mean of each image and its mean target exposure. Gradients flow to both."""
    return jnp.abs(dark.mean((1, 2)) - exposure.mean((1, 2))).mean()


def spatial_loss(dark: Float[Array, "B H W"], lightness: Float[Array, "B H W"]) -> Scalar:
    """Squared error of the differences between neighbouring blocks, against the input scaled to the same mean.

    Gradients flow to `dark`, but not through that scale.
    """
    mean = lambda image: image.mean((1, 2), keepdims=True)
    scale = jax.lax.stop_gradient(mean(dark) / jnp.maximum(mean(lightness), 1e-6))
    return squared_steps(block_means(dark - scale * lightness, BLOCK)[..., None])


def smoothness_loss(curves: Float[Array, "B H W R"]) -> Scalar:
    """Squared differences of neighbouring pixels, summed over the curve parameters (Zero-DCE's total variation)."""
    return curves.shape[-1] * squared_steps(curves)


def train(
    net: Net, batches: Iterable[Batch], rate: optimizer.Schedule, objective: Callable[..., Scalar] = loss
) -> Iterator[tuple[Net, Scalar]]:
    """One step of Adam per batch; yields the network after it and the loss before it.

    Args:
        net: parameters.
        batches: further arguments of `objective`; by default lightness and exposure maps.
        rate: schedule of the learning rate.
        objective: the loss.
    """
    adam = optimizer.adam(jax.tree.map(lambda _: "net", net), {"net": rate}, 0.9, 0.999, 1e-8)

    @jax.jit
    def step(net: Net, state: optimizer.AdamState, batch: Batch) -> tuple[Net, optimizer.AdamState, Scalar]:
        value, gradients = jax.value_and_grad(objective)(net, *batch)
        move, state = adam.update(gradients, state, net)
        return jax.tree.map(jnp.add, net, move), state, value

    state = adam.init(net)
    for batch in batches:
        net, state, value = step(net, state, batch)
        yield net, value


def squared_steps(image: Float[Array, "B H W R"]) -> Scalar:
    """Mean squared difference from the neighbours: those in x plus those in y, each counted from both sides."""
    return 2 * (jnp.square(jnp.diff(image, axis=1)).mean() + jnp.square(jnp.diff(image, axis=2)).mean())
