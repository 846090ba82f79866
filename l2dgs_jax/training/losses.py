"""The training objective (Eqs. 10-15), one pure function per term.

Every term is a mean over pixels and views; an empty mean (differences in a one-pixel image) is 0.
"""

from collections.abc import Callable
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax import metrics
from l2dgs_jax.config import LossConfig
from l2dgs_jax.model.decomposition import power
from l2dgs_jax.types import RenderOutput

Scalar = Float[Array, ""]
Terms = dict[str, tuple[Scalar | float, Callable[[], Scalar]]]  # weight and value by name


def total(
    render: RenderOutput,
    target: Float[Array, "V H W 3"],
    cfg: LossConfig,
    eta: Scalar | float,
    exponent_target: Scalar | float = 1.0,
    valid: Bool[Array, "V H W"] | None = None,
) -> tuple[Scalar, dict[str, Scalar]]:
    """Eq. 15 over V views, plus the optional total variation of L_w and exponent prior; plane regularisers excluded.

    Gradients flow to `render.images` and `render.depth`.

    Args:
        render: V rendered views.
        target: the low-light frames, sRGB in [0, 1].
        cfg: weights and forms.
        eta: exponent of Eq. 10 at this step (see `eta`).
        exponent_target: value that the exponent prior pulls B1 to.
        valid: pixels whose brightness counts for exposure control; None for all.

    Returns:
        The weighted sum, and each term before its weight by name. Terms of weight 0 are neither computed nor listed,
        unless that weight is traced.
    """
    images = render.images
    exposed = images.reflectance if cfg.exposure_of == "reflectance" else images.welllit
    illumination = images.illumination[..., None]
    b1, b2 = images.attenuation[..., :1], images.attenuation[..., 1:]
    level: Scalar | float = cfg.exposure_level  # type: ignore[assignment]  # "auto" is resolved
    lambda4 = cfg.structure if cfg.structure_illumination is None else cfg.structure_illumination
    beta2 = cfg.structure_beta if cfg.structure_beta_illumination is None else cfg.structure_beta_illumination
    terms: Terms = {
        "l1": (1.0, lambda: photometric_l1(images.lowlight, target, cfg.l1_on, eta, cfg.eps)),
        "ssim": (cfg.ssim, lambda: photometric_ssim(images.lowlight, target, eta, cfg.eps)),
        "exposure": (
            cfg.exposure,
            lambda: exposure(exposed, level, cfg.exposure_window, cfg.exposure_form, valid),
        ),
        "amplification": (cfg.amplification, lambda: amplification(images.illumination)),
        "reflectance_amplification": (cfg.reflectance_amplification, lambda: amplification(images.reflectance)),
        "structure_reflectance": (
            cfg.structure,
            lambda: structure(b1, images.reflectance, cfg.structure_beta, cfg.structure_gradient),
        ),
        "structure_illumination": (
            lambda4,
            lambda: structure(b2, illumination, beta2, cfg.structure_gradient),
        ),
        "depth": (
            cfg.depth,
            lambda: depth_smoothness(cfg.depth_gain * render.depth, images.welllit, cfg.depth_gradient),
        ),
        "illumination_tv": (cfg.illumination_tv, lambda: total_variation(images.illumination)),
        "exponent_prior": (cfg.exponent_prior, lambda: exponent_prior(images.attenuation, exponent_target)),
    }
    return weighted_sum(terms)


def weighted_sum(terms: Terms) -> tuple[Scalar, dict[str, Scalar]]:
    """The sum of weight * term, and each term by name; those of weight 0 are left out, unless that weight is traced."""
    values = {
        name: term() for name, (weight, term) in terms.items() if not (isinstance(weight, float | int) and weight == 0)
    }
    weighted = [terms[name][0] * value for name, value in values.items()]
    return jnp.stack(weighted).sum() if weighted else jnp.asarray(0.0), values


def eta(step: Int[Array, ""] | int, steps: int, cfg: LossConfig) -> Scalar:
    """Exponent of Eq. 10: decays exponentially from `cfg.eta_start` to `cfg.eta_end` over `steps`, then stays."""
    fraction = jnp.clip(jnp.asarray(step) / max(steps, 1), 0, 1)
    return cfg.eta_start * (cfg.eta_end / cfg.eta_start) ** fraction


def tonemap(image: Float[Array, "*S"], eta: Scalar | float, eps: Scalar | float) -> Float[Array, "*S"]:
    """(I + eps)^eta of Eq. 10, which lifts dark values; `image` >= 0 carries gradients."""
    return power(image + eps, jnp.asarray(eta, image.dtype))


def photometric_l1(
    prediction: Float[Array, "*B H W C"],
    target: Float[Array, "*B H W C"],
    on: Literal["raw", "tonemapped"],
    eta: Scalar | float,
    eps: Scalar | float,
) -> Scalar:
    """First term of Eq. 10: mean absolute difference, of the images or of the `tonemap`ped images."""
    if on == "tonemapped":
        prediction, target = (tonemap(image, eta, eps) for image in (prediction, target))
    return jnp.abs(prediction - target).mean()


def photometric_ssim(
    prediction: Float[Array, "*B H W C"], target: Float[Array, "*B H W C"], eta: Scalar | float, eps: Scalar | float
) -> Scalar:
    """Second term of Eq. 10: 1 - SSIM of the `tonemap`ped images, windows padded with zeros."""
    return 1 - metrics.ssim_map(tonemap(prediction, eta, eps), tonemap(target, eta, eps)).mean()


def exposure(
    image: Float[Array, "*B H W C"],
    level: Scalar | float,
    window: int | None,
    form: Literal["absolute", "squared"],
    valid: Bool[Array, "*B H W"] | None = None,
) -> Scalar:
    """Exposure control (Eq. 11; Zero-DCE, arXiv 2001.06826): distance of local mean intensity from a level.

    Args:
        image: R_w or I_w; carries gradients.
        level: e, the wanted mean.
        window: side of the square blocks, in pixels; blocks that the image cuts off are left out. None, or a window
            larger than the image: one block, the whole image.
        form: |mean - e| (paper) or (mean - e)^2 (Zero-DCE's code).
        valid: pixels that count, all others having the wanted intensity; None for all.
    """
    excess = image.mean(-1) - level
    if valid is not None:
        excess = jnp.where(valid, excess, 0)
    if window is None or window > min(excess.shape[-2:]):
        distance = excess.mean((-2, -1))
    else:
        distance = block_means(excess, window)
    return (jnp.abs(distance) if form == "absolute" else distance**2).mean()


def block_means(values: Float[Array, "*B H W"], side: int) -> Float[Array, "*B h w"]:
    """Means over square blocks of that side in pixels; blocks that the image cuts off are left out."""
    *batch, height, width = values.shape
    rows, columns = height // side, width // side
    whole = values[..., : rows * side, : columns * side]
    return whole.reshape(*batch, rows, side, columns, side).mean((-3, -1))


def depth_smoothness(
    depth: Float[Array, "*B H W"], image: Float[Array, "*B H W C"], gradient: Literal["forward", "sobel"]
) -> Scalar:
    """Edge-aware smoothness (Eq. 12): depth steps count less where the image has an edge; both carry gradients.

    Args:
        depth: D, in any unit.
        image: I_w.
        gradient: forward differences, or unnormalised 3x3 Sobel filters with zeros beyond the image (the authors').
            The image gradient is averaged over channels in absolute value.
    """

    def smoothness(step: Float[Array, "..."], edge: Float[Array, "..."]) -> Scalar:
        return _mean(jnp.abs(step) * jnp.exp(-jnp.abs(edge).mean(-1, keepdims=True)))

    differences = _forward if gradient == "forward" else _sobel
    (depth_x, depth_y), (image_x, image_y) = differences(depth[..., None]), differences(image)
    return smoothness(depth_x, image_x) + smoothness(depth_y, image_y)


def amplification(image: Float[Array, "*B"]) -> Scalar:
    """Signal amplification (Eq. 13): mean |1 - L_w|, or of R_w in its place."""
    return jnp.abs(1 - image).mean()


def structure(
    exponent: Float[Array, "*B H W 1"],
    guide: Float[Array, "*B H W C"],
    beta: Scalar | float,
    gradient: Literal["components", "magnitude"],
) -> Scalar:
    """Scene-adaptive structure (Eq. 14): mean |beta grad B - grad guide|; both images carry gradients.

    Args:
        exponent: B1 or B2, compared with every channel of its guide.
        guide: R_w for B1, L_w for B2.
        beta: scale of the exponent's gradient.
        gradient: forward differences in x and in y, one mean each; or the magnitude of central differences
            [-1, 0, 1] with zeros beyond the image (the authors').
    """
    if gradient == "magnitude":
        return jnp.abs(beta * _magnitude(exponent) - _magnitude(guide)).mean()
    (exponent_x, exponent_y), (guide_x, guide_y) = _forward(exponent), _forward(guide)
    return _mean(jnp.abs(beta * exponent_x - guide_x)) + _mean(jnp.abs(beta * exponent_y - guide_y))


def total_variation(image: Float[Array, "*B H W"]) -> Scalar:
    """Mean |forward difference| in x plus the same in y."""
    dx, dy = _forward(image[..., None])
    return _mean(jnp.abs(dx)) + _mean(jnp.abs(dy))


def exponent_prior(attenuation: Float[Array, "*B H W 2"], target: Scalar | float) -> Scalar:
    """Mean |B1 - target|: keeps the colours of the well-lit image from drifting along with the exponent of R_w."""
    return jnp.abs(attenuation[..., 0] - target).mean()


def _mean(values: Float[Array, "..."]) -> Scalar:
    return values.sum() / max(values.size, 1)


def _forward(image: Float[Array, "*B H W C"]) -> tuple[Float[Array, "*B H W_1 C"], Float[Array, "*B H_1 W C"]]:
    return jnp.diff(image, axis=-2), jnp.diff(image, axis=-3)


def _central(image: Float[Array, "*B H W C"]) -> tuple[Float[Array, "*B H W C"], Float[Array, "*B H W C"]]:
    """[-1, 0, 1] in x and in y, not halved, with zeros beyond the image."""
    padded = _pad(image)
    dx = padded[..., 1:-1, 2:, :] - padded[..., 1:-1, :-2, :]
    dy = padded[..., 2:, 1:-1, :] - padded[..., :-2, 1:-1, :]
    return dx, dy


def _sobel(image: Float[Array, "*B H W C"]) -> tuple[Float[Array, "*B H W C"], Float[Array, "*B H W C"]]:
    """Central differences smoothed by [1, 2, 1] across, unnormalised."""
    dx, dy = (_pad(difference) for difference in _central(image))
    across_y = dx[..., :-2, 1:-1, :] + 2 * dx[..., 1:-1, 1:-1, :] + dx[..., 2:, 1:-1, :]
    across_x = dy[..., 1:-1, :-2, :] + 2 * dy[..., 1:-1, 1:-1, :] + dy[..., 1:-1, 2:, :]
    return across_y, across_x


def _magnitude(image: Float[Array, "*B H W C"]) -> Float[Array, "*B H W C"]:
    dx, dy = _central(image)
    return jnp.sqrt(dx**2 + dy**2 + 1e-6)


def _pad(image: Float[Array, "*B H W C"]) -> Float[Array, "*B H+2 W+2 C"]:
    return jnp.pad(image, [(0, 0)] * (image.ndim - 3) + [(1, 1), (1, 1), (0, 0)])
