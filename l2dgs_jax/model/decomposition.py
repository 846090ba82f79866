"""Rasterized features -> the well-lit image and the low-light image it must explain (Eqs. 5-9)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.data.color import linear_to_srgb, srgb_to_linear
from l2dgs_jax.kernels.fusion import fusion_boundary, repeat_channels
from l2dgs_jax.model import channels
from l2dgs_jax.model.networks import apply_bafe, bounded_exponents
from l2dgs_jax.types import BAFENet, Decomposition


def decompose(features: Float[Array, "*B H W 6"], bafe: BAFENet, cfg: ModelConfig) -> Decomposition:
    """Turn blended features into L_w, R_w, B1, B2, I_w and the estimate of I_d.

    Gradients flow, in reverse mode only, to `features` (L_w and R_w: only where they lie in [0, 1], both ends included)
    and to `bafe`.

    Args:
        features: blended channels, any real values (Eqs. 5, 6, 8; see `channels`).
        bafe: parameters of BAFE-Net.
        cfg: `decomposition`, `domain`, `relative_light`, `bafe` and `unit_exponent`.

    Returns:
        The images of Eqs. 5-9; a base of 0 stays 0 in the low-light image and passes no gradient to its exponent.
        Without the Retinex decomposition both images are the blended colour, and L_w and the exponents are 1; if
        there are tone curves, `render` computes the low-light image by them instead.
    """
    # Without this boundary XLA would compute the losses' gradient again for each of the channels.
    illumination, reflectance, attenuation = fusion_boundary(channels.unpack)(features)
    illumination, reflectance = clip_unit(illumination), clip_unit(reflectance)
    if cfg.decomposition != "retinex":
        return Decomposition(
            welllit=reflectance,
            lowlight=reflectance,
            illumination=jnp.ones_like(illumination),
            reflectance=reflectance,
            attenuation=jnp.ones_like(attenuation),
        )
    attenuation = apply_bafe(bafe, attenuation) if cfg.bafe else bounded_exponents(bafe, attenuation)
    if cfg.unit_exponent is not None:
        attenuation = attenuation.at[..., ("b1", "b2").index(cfg.unit_exponent)].set(1)
    color = as_light(reflectance, cfg)
    return Decomposition(
        welllit=product(illumination / full_light(cfg), color, cfg),
        lowlight=product(
            power(illumination, attenuation[..., 1]),
            power(color, repeat_channels(attenuation[..., 0], 3)),
            cfg,
        ),
        illumination=illumination,
        reflectance=reflectance,
        attenuation=attenuation,
    )


def as_light(reflectance: Float[Array, "*S"], cfg: ModelConfig) -> Float[Array, "*S"]:
    """R_w as Eqs. 7 and 9 use it: its sRGB values, or by `cfg.domain` the linear light that they encode."""
    return srgb_to_linear(reflectance) if cfg.domain == "light" else reflectance


def product(light: Float[Array, "*B"], color: Float[Array, "*B 3"], cfg: ModelConfig) -> Float[Array, "*B 3"]:
    """Light times colour (as `as_light` gives it), in sRGB values; both carry gradients where that is at most 1."""
    image = repeat_channels(light, 3) * color
    image = linear_to_srgb(image) if cfg.domain == "light" else image
    return clip_unit(image) if cfg.relative_light else image


def full_light(cfg: ModelConfig) -> Float[Array, ""] | float:
    """The L_w at which I_w equals R_w: 1, or with `cfg.relative_light` the initial L_w."""
    return cfg.initial_illumination if cfg.relative_light else 1.0  # type: ignore[return-value]  # "auto" is resolved


def clip_unit(x: Float[Array, "*S"]) -> Float[Array, "*S"]:
    """Clip to [0, 1] with slope 1 on the closed interval and 0 outside.

    `jnp.clip` halves the gradient of values that lie exactly on a bound, where saturated pixels gather.
    """
    return jnp.where((x >= 0) & (x <= 1), x, jax.lax.stop_gradient(jnp.clip(x, 0, 1)))


def power(base: Float[Array, "*S"], exponent: Float[Array, "*E"]) -> Float[Array, "*S"]:
    """Return base ** exponent for bases >= 0 and exponents > 0, both carrying gradients (Eqs. 9, 10).

    A base of 0, or too small to have a finite reciprocal, gives 0 with zero gradients.

    Args:
        base: bases.
        exponent: exponents: one for all, or of the rank of `base` and broadcastable to it.
    """
    positive = base >= jnp.finfo(base.dtype).tiny
    log_base = jnp.log(jnp.where(positive, base, 1))
    return jnp.where(positive, jnp.exp(exponent * log_base), 0)
