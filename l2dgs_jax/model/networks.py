"""The small networks, motion heads, OCD-Net and BAFE-Net: `init_*` -> parameters, `apply_*(parameters, x)` -> y.

The paper leaves their layers to its supplement; sizes and activations here are those of the authors' release.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.kernels.convolution import convolve
from l2dgs_jax.types import BAFENet, Conv, GroupNorm, Linear, Motion, MotionHeads, OCDNet

# B1 and B2 lie in the open interval EXPONENT_CENTRE -/+ EXPONENT_HALF_RANGE, which is (1, 10).
EXPONENT_CENTRE = 5.5
EXPONENT_HALF_RANGE = 4.5
LEAKY_SLOPE = 0.01  # of leaky ReLU for negative values
GROUP_NORM_EPS = 1e-5
SKIP_GAIN = 0.3  # factor on the skip connection from BAFE-Net's first block to its third


def init_heads(key: PRNGKeyArray, feature_size: int, cfg: ModelConfig) -> MotionHeads:
    """The aggregation g of Eq. 1 and the mu, Q and S heads: Xavier-uniform weights, zero biases.

    With `cfg.identity_start` the last layer of each head is zero: no motion, yet non-zero gradients in that layer.

    Args:
        key: randomness of the weights.
        feature_size: channels of a HexPlane feature.
        cfg: `hidden`, `identity_start` and `opacity_head`.
    """
    keys = jax.random.split(key, 9)

    def head(first: PRNGKeyArray, last: PRNGKeyArray, size: int) -> tuple[Linear, Linear]:
        out = _linear(last, cfg.hidden, size)
        return _linear(first, cfg.hidden, cfg.hidden), jax.tree.map(jnp.zeros_like, out) if cfg.identity_start else out

    return MotionHeads(
        aggregate=_linear(keys[0], feature_size, cfg.hidden),
        mean=head(keys[1], keys[2], 3),
        quat=head(keys[3], keys[4], 4),
        scale=head(keys[5], keys[6], 3),
        opacity=head(keys[7], keys[8], 1) if cfg.opacity_head else None,
    )


def apply_heads(heads: MotionHeads, features: Float[Array, "*B F"]) -> tuple[Float[Array, "*B H"], Motion]:
    """Displacements at an instant, to be added to raw parameters. Gradients flow to both arguments.

    Args:
        heads: parameters.
        features: HexPlane features.

    Returns:
        f of Eq. 1, and the displacements.
    """
    hidden = _affine(heads.aggregate, features)
    active = jax.nn.relu(hidden)

    def move(head: tuple[Linear, Linear]) -> Float[Array, "..."]:
        return _affine(head[1], jax.nn.relu(_affine(head[0], active)))

    return hidden, Motion(
        means=move(heads.mean),
        quats=move(heads.quat),
        log_scales=move(heads.scale),
        logit_opacities=None if heads.opacity is None else move(heads.opacity)[..., 0],
    )


def init_ocd(key: PRNGKeyArray, cfg: ModelConfig) -> OCDNet:
    """OCD-Net (Eq. 4): Xavier-uniform weights, zero biases.

    With `cfg.identity_start` every a_j starts at exactly 1, where the last ReLU passes gradients. Without, about half
    of them start at 0 and the illumination jumps when OCD-Net is switched on.

    Args:
        key: randomness of the weights.
        cfg: `hidden`, `sh_degree` and `identity_start`.
    """
    first, last = jax.random.split(key)
    out = _linear(last, cfg.hidden, (cfg.sh_degree + 1) ** 2)
    if cfg.identity_start:
        out = Linear(jnp.zeros_like(out.weight), jnp.ones_like(out.bias))
    return OCDNet(_linear(first, cfg.hidden, cfg.hidden), out)


def apply_ocd(ocd: OCDNet, hidden: Float[Array, "*B H"]) -> Float[Array, "*B J"]:
    """The factors a_j(t) >= 0 of Eq. 4. Gradients flow to both arguments.

    Args:
        ocd: parameters.
        hidden: f of Eq. 1.
    """
    return jax.nn.relu(_affine(ocd.out, _elu(_affine(ocd.hidden, _elu(hidden)))))


def init_bafe(key: PRNGKeyArray, bias: Float[Array, "2"] | None) -> BAFENet:
    """BAFE-Net: Xavier-uniform kernels, zero biases, exponents near 5.5.

    With `bias` the last layer starts with that bias and a zero kernel, so that the exponents start exactly at
    the values it stands for; the first step makes the kernel non-zero, and the earlier layers begin to learn.

    Args:
        key: randomness of the kernels.
        bias: of the last layer, as `exponent_bias` returns it; or None.
    """
    keys = jax.random.split(key, 4)
    norm = lambda channels: GroupNorm(jnp.ones(channels), jnp.zeros(channels))
    out = init_conv(keys[3], 1, 8, 2)
    if bias is not None:
        out = Conv(jnp.zeros_like(out.weight), bias.astype(out.bias.dtype))
    return BAFENet(
        conv1=init_conv(keys[0], 5, 2, 8),
        norm1=norm(8),
        conv2=init_conv(keys[1], 3, 8, 16),
        norm2=norm(16),
        conv3=init_conv(keys[2], 3, 16, 8),
        norm3=norm(8),
        out=out,
    )


def exponent_bias(exponents: tuple[Any, Any]) -> Float[np.ndarray, "2"]:
    """What BAFE-Net's last layer must give for these B1 and B2 to come out.

    Raises:
        ValueError: one of them is not a number strictly between 1 and 10.
    """
    for value in exponents:
        if isinstance(value, str) or not abs(value - EXPONENT_CENTRE) < EXPONENT_HALF_RANGE:
            raise ValueError(f"initial exponents must be numbers strictly between 1 and 10, not {value}")
    soft_sign = (np.array(exponents, float) - EXPONENT_CENTRE) / EXPONENT_HALF_RANGE
    return soft_sign / (1 - np.abs(soft_sign))


def apply_bafe(bafe: BAFENet, attenuation: Float[Array, "*B H W 2"]) -> Float[Array, "*B H W 2"]:
    """The exponents B1 and B2 of Eq. 9, each in (1, 10). Gradients flow to both arguments.

    Normalisation uses the statistics of each whole image, so the exponents of a crop are not a crop of the exponents.

    Args:
        bafe: parameters.
        attenuation: the rasterized (b1, b2) of Eq. 8.
    """
    x = jnp.tanh(attenuation.reshape(-1, *attenuation.shape[-3:]))
    leaky = lambda y: jax.nn.leaky_relu(y, LEAKY_SLOPE)
    first = leaky(_group_norm(bafe.norm1, apply_conv(bafe.conv1, x), 2))
    second = leaky(_group_norm(bafe.norm2, apply_conv(bafe.conv2, first), 4))
    third = leaky(_group_norm(bafe.norm3, apply_conv(bafe.conv3, second), 2) + SKIP_GAIN * first)
    return _bound(apply_conv(bafe.out, third)).reshape(attenuation.shape)


def bounded_exponents(bafe: BAFENet, attenuation: Float[Array, "*B H W 2"]) -> Float[Array, "*B H W 2"]:
    """Exponents in (1, 10) from the rasterized (b1, b2) alone: BAFE-Net reduced to its last bias and the range.

    Gradients flow to both arguments.
    """
    return _bound(attenuation + jnp.broadcast_to(bafe.out.bias, attenuation.shape))


def _bound(x: Float[Array, "*S"]) -> Float[Array, "*S"]:
    return EXPONENT_CENTRE + EXPONENT_HALF_RANGE * jax.nn.soft_sign(x)


def _xavier(key: PRNGKeyArray, shape: tuple[int, ...], fan_in: int, fan_out: int) -> Float[Array, "..."]:
    limit = (6 / (fan_in + fan_out)) ** 0.5
    return jax.random.uniform(key, shape, minval=-limit, maxval=limit)


def _linear(key: PRNGKeyArray, inputs: int, outputs: int) -> Linear:
    return Linear(_xavier(key, (inputs, outputs), inputs, outputs), jnp.zeros(outputs))


def _affine(layer: Linear, x: Float[Array, "*B I"]) -> Float[Array, "*B O"]:
    # The barrier makes XLA compute the weights' gradient as it is written, narrow times wide: on a CPU the transposed
    # product takes several times as long.
    weight = jax.lax.optimization_barrier(layer.weight.T)
    flat = jax.lax.dot_general(x.reshape(-1, x.shape[-1]), weight, (((1,), (1,)), ((), ()))) + layer.bias[None]
    return flat.reshape(*x.shape[:-1], -1)


def _elu(x: Float[Array, "*S"]) -> Float[Array, "*S"]:
    # Not expm1, which takes three times as long: the digits that it gains near 0 are lost beside values near 1.
    return jnp.where(x > 0, x, jnp.exp(jnp.minimum(x, 0)) - 1)


def init_conv(key: PRNGKeyArray, size: int, inputs: int, outputs: int) -> Conv:
    """A `size` x `size` convolution with a Xavier-uniform kernel and a zero bias."""
    weight = _xavier(key, (size, size, inputs, outputs), size * size * inputs, size * size * outputs)
    return Conv(weight, jnp.zeros(outputs))


def apply_conv(layer: Conv, x: Float[Array, "B H W I"]) -> Float[Array, "B H W O"]:
    """Convolution with zero padding that keeps the size. Gradients flow to both arguments."""
    return convolve(x, layer.weight) + layer.bias[None, None, None]


def _group_norm(layer: GroupNorm, x: Float[Array, "B H W C"], groups: int) -> Float[Array, "B H W C"]:
    """Zero mean and unit variance over each image and group of channels, then an affine map per channel."""

    def pool(y: Float[Array, "B H W C"]) -> Float[Array, "B 1 1 C"]:
        # Pooling the pixels first keeps the channel axis whole; statistics over a split axis are much slower on CPU.
        means = y.mean((1, 2)).reshape(len(y), groups, -1).mean(-1)
        return jnp.repeat(means, y.shape[-1] // groups, axis=-1)[:, None, None]

    centred = x - pool(x)
    gain = layer.scale[None, None, None] * jax.lax.rsqrt(pool(jnp.square(centred)) + GROUP_NORM_EPS)
    return centred * gain + layer.bias[None, None, None]
