"""Zero-DCE (arXiv 2001.06826): per-pixel curves that brighten a picture, learned from dark pictures alone."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from tqdm import tqdm

from l2dgs_jax.data.dataset import Split
from l2dgs_jax.model.networks import apply_conv, init_conv
from l2dgs_jax.preprocess.lowlight.curve_network import BLOCK, iterate, smoothness_loss, squared_steps, train
from l2dgs_jax.training.losses import block_means, exposure
from l2dgs_jax.training.optimizer import Schedule
from l2dgs_jax.types import Conv

ITERATIONS, WIDTH = 8, 32  # of the curve; channels of every hidden layer
EXPOSURE_LEVEL, EXPOSURE_WINDOW = 0.6, 16  # target mean of every block, and its side in pixels
SPATIAL_WEIGHT, EXPOSURE_WEIGHT, COLOR_WEIGHT, SMOOTHNESS_WEIGHT = 1.0, 10.0, 5.0, 200.0
# A few frames of one scene need fewer and larger steps than photographs of all kinds.
STEPS, BATCH, CROP, RATES = 200, 4, 64, (1e-3, 1e-4)

Net = tuple[Conv, ...]  # seven 3x3 convolutions; the last three also read outputs of earlier ones
Scalar = Float[Array, ""]


def init(key: PRNGKeyArray) -> Net:
    """Xavier-uniform kernels, zero biases."""
    sizes = ((3, WIDTH), *((WIDTH, WIDTH),) * 3, *((2 * WIDTH, WIDTH),) * 2, (2 * WIDTH, 3 * ITERATIONS))
    return tuple(init_conv(k, 3, *size) for k, size in zip(jax.random.split(key, len(sizes)), sizes, strict=True))


def curves(net: Net, images: Float[Array, "B H W 3"]) -> Float[Array, "B H W 24"]:
    """Parameters of every pixel's curves, in [-1, 1]: `ITERATIONS` for each channel. Gradients flow to both."""
    x = [images]
    for layer in net[:4]:
        x.append(jax.nn.relu(apply_conv(layer, x[-1])))
    for layer, skip in zip(net[4:6], (3, 2), strict=True):
        x.append(jax.nn.relu(apply_conv(layer, jnp.concatenate([x[skip], x[-1]], -1))))
    return jnp.tanh(apply_conv(net[6], jnp.concatenate([x[1], x[-1]], -1)))


def brighten(net: Net, images: Float[Array, "B H W 3"]) -> Float[Array, "B H W 3"]:
    """Pictures after applying their curves; sRGB values stay in [0, 1]. Gradients flow to both."""
    return _bend(images, curves(net, images))


def _bend(images: Float[Array, "B H W 3"], curves: Float[Array, "B H W 24"]) -> Float[Array, "B H W 3"]:
    return iterate(images, -curves.reshape(*images.shape, ITERATIONS))


def loss(net: Net, images: Float[Array, "B H W 3"]) -> Scalar:
    """Zero-DCE's objective: keep differences between blocks, expose blocks well, grey mean, smooth curves.

    The terms are those of the paper, the weights those of its authors' code.
    """
    parameters = curves(net, images)
    bright = _bend(images, parameters)
    means = bright.mean((1, 2))
    tints = means - jnp.roll(means, 1, axis=-1)
    return (
        SPATIAL_WEIGHT * squared_steps(block_means((bright - images).mean(-1), BLOCK)[..., None])
        + EXPOSURE_WEIGHT * exposure(bright, EXPOSURE_LEVEL, EXPOSURE_WINDOW, "squared")
        + COLOR_WEIGHT * jnp.square(tints).sum(-1).mean()
        + SMOOTHNESS_WEIGHT * smoothness_loss(parameters)
    )


def learn(split: Split, seed: int) -> Net:
    """Train a network on the frames of one scene; pixels that are not valid take on the mean of the others."""
    net = init(jax.random.key(seed))
    rate = Schedule(*(jnp.asarray(value, float) for value in (*RATES, STEPS)))
    bar = tqdm(_crops(split, seed), total=STEPS, desc="brighten", unit="step", dynamic_ncols=True, disable=None)
    for net, _ in train(net, iter(bar), rate, loss):  # noqa: B007, B020
        pass
    return net


def _crops(split: Split, seed: int) -> Iterator[tuple[Float[Array, "B h w 3"]]]:
    """Batches of random crops of random pictures, half of them mirrored."""
    rng = np.random.default_rng(seed)
    frames, height, width, _ = split.images.shape
    rows, columns = min(CROP, height), min(CROP, width)

    def crop() -> Float[np.ndarray, "h w 3"]:
        frame = rng.integers(frames)
        row, column = rng.integers(height - rows + 1), rng.integers(width - columns + 1)
        window = slice(row, row + rows), slice(column, column + columns)
        part = split.images[frame][window]
        if split.valid is not None:
            part = np.where(split.valid[frame][window][..., None], part, split.mean_level)
        return part[:, ::-1] if rng.random() < 0.5 else part

    for _ in range(STEPS):
        yield (jnp.asarray(np.stack([crop() for _ in range(BATCH)]), float),)
