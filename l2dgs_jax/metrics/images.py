"""Image quality: PSNR and SSIM, and their masked forms."""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from l2dgs_jax.kernels.fusion import unfused_on_cpu

RADIUS = 5  # of the 11x11 SSIM window
SIGMA = 1.5  # pixels
WINDOW = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SIGMA) ** 2)
WINDOW /= WINDOW.sum()
C1, C2 = 0.01**2, 0.03**2  # for values in [0, 1]

NO_VALUE = -np.inf  # in maps of local values where there is none; NaN means that a computation failed

Border = Literal["zero", "mirror"]


def ssim_map(
    a: Float[Array, "*B H W C"], b: Float[Array, "*B H W C"], border: Border = "zero"
) -> Float[Array, "*B H W C"]:
    """Structural similarity around each pixel, in an 11x11 Gaussian window of sigma 1.5, per channel.

    Source: Wang et al. 2004 with the population covariance. Gradients flow to both images, reverse mode only.

    Args:
        a: image with values in [0, 1].
        b: image with values in [0, 1].
        border: padding of the images: with zeros ("zero", as in 3D Gaussian Splatting's loss) or mirrored about the
            edge ("mirror", as in scikit-image).
    """
    if border == "mirror":
        edges = [(0, 0)] * (a.ndim - 3) + [(RADIUS, RADIUS)] * 2 + [(0, 0)]
        a, b = (jnp.pad(image, edges, "symmetric") for image in (a, b))
    similarity = _similarity(*map(_blur, (a, b, a * a + b * b, a * b)))
    return similarity if border == "zero" else similarity[..., RADIUS:-RADIUS, RADIUS:-RADIUS, :]


def valid_ssim_map(
    a: Float[Array, "H W C"], b: Float[Array, "H W C"], valid: Bool[Array, "H W"]
) -> Float[Array, "H W C"]:
    """`ssim_map` of valid pixels: the others, and those beyond the image, have no weight in its windows."""
    a, b = (jnp.where(valid[..., None], image, 0) for image in (a, b))
    weights = jnp.maximum(_blur(valid.astype(a.dtype)[..., None]), jnp.finfo(a.dtype).tiny)
    return _similarity(*(_blur(x) / weights for x in (a, b, a * a + b * b, a * b)))


def _similarity(
    mean_a: Float[Array, "*B H W C"],
    mean_b: Float[Array, "*B H W C"],
    square: Float[Array, "*B H W C"],
    product: Float[Array, "*B H W C"],
) -> Float[Array, "*B H W C"]:
    """SSIM given means over windows: of two images, of the sum of their squares, and of their product."""
    means = mean_a * mean_b
    mean_squares = mean_a * mean_a + mean_b * mean_b  # only the sum of the two variances enters SSIM
    return ((2 * means + C1) * (2 * (product - means) + C2)) / ((mean_squares + C1) * (square - mean_squares + C2))


def ssim(a: Float[Array, "*B H W C"], b: Float[Array, "*B H W C"]) -> Float[Array, "*B"]:
    """Mean SSIM over the windows that lie inside the image, as in scikit-image; over all windows if none does."""
    similarity = ssim_map(a, b, "mirror")
    height, width = a.shape[-3:-1]
    if min(height, width) > 2 * RADIUS:
        similarity = similarity[..., RADIUS:-RADIUS, RADIUS:-RADIUS, :]
    return similarity.mean((-3, -2, -1))


def inside(windows: Float[np.ndarray, "H W C"]) -> Float[np.ndarray, "H W C"]:
    """A copy of a map of window values, with `NO_VALUE` where the window around a pixel extends beyond the image."""
    kept = np.full_like(windows, NO_VALUE)
    kept[RADIUS:-RADIUS, RADIUS:-RADIUS] = windows[RADIUS:-RADIUS, RADIUS:-RADIUS]
    return kept


def partial_ssim(a: Float[Array, "H W C"], b: Float[Array, "H W C"], mask: Bool[Array, "H W"]) -> Float[Array, ""]:
    """DyCheck's mSSIM: mean SSIM over the windows inside the image, each of which uses only its pixels in a mask.

    Source: arXiv 2210.13445 and its code. Sums along a window's side are scaled by its length over the number of pixels
    in the mask, whatever their weights. In windows without any such pixel the images count as equal. If the image is
    too small for a window, the result is the mean of its SSIM map over the mask.
    """
    if min(a.shape[:2]) <= 2 * RADIUS:
        return _masked_mean(ssim_map(a, b, "mirror"), mask)

    def shifted(x: Float[Array, "..."], axis: int) -> list[Float[Array, "..."]]:
        length = x.shape[axis] - 2 * RADIUS
        return [jax.lax.slice_in_dim(x, k, k + length, axis=axis) for k in range(len(WINDOW))]

    def blur(images: Float[Array, "H W C"]) -> Float[Array, "h w C"]:
        seen = jnp.asarray(mask, images.dtype)[..., None]
        for axis in (1, 0):
            count = jnp.stack(shifted(seen, axis)).sum(0)
            total = sum(float(w) * x for w, x in zip(WINDOW, shifted(images * seen, axis), strict=True))
            images = jnp.where(count > 0, total * len(WINDOW) / jnp.maximum(count, 1), 0)
            seen = jnp.asarray(count > 0, images.dtype)
        return images

    mean_a, mean_b, square_a, square_b, product = map(blur, (a, b, a * a, b * b, a * b))
    var_a, var_b = jnp.maximum(square_a - mean_a**2, 0), jnp.maximum(square_b - mean_b**2, 0)
    bound = jnp.sqrt(var_a * var_b)
    covariance = jnp.clip(product - mean_a * mean_b, -bound, bound)
    return (
        ((2 * mean_a * mean_b + C1) * (2 * covariance + C2)) / ((mean_a**2 + mean_b**2 + C1) * (var_a + var_b + C2))
    ).mean()


def psnr(
    a: Float[Array, "*B H W C"], b: Float[Array, "*B H W C"], mask: Bool[Array, "*B H W"] | None = None
) -> Float[Array, "*B"]:
    """Peak signal-to-noise ratio, dB, for values in [0, 1]; with `mask`, of its pixels (mPSNR, arXiv 2210.13445).

    Infinite for equal images, NaN where the mask is empty. Gradients flow to both images.
    """
    error = (a - b) ** 2
    return -10 * jnp.log10(error.mean((-3, -2, -1)) if mask is None else _masked_mean(error, mask))


def _masked_mean(values: Float[Array, "*B H W C"], mask: Bool[Array, "*B H W"]) -> Float[Array, "*B"]:
    weights = mask.astype(values.dtype)
    return (values.mean(-1) * weights).sum((-2, -1)) / weights.sum((-2, -1))


def _window_mean(images: Float[Array, "*B H W C"]) -> Float[Array, "*B H W C"]:
    """The mean in a Gaussian window around each pixel, with zeros beyond the image."""

    def along(axis: int, x: Float[Array, "*B H W C"]) -> Float[Array, "*B H W C"]:
        padded = jnp.pad(x, [(RADIUS, RADIUS) if k == x.ndim + axis else (0, 0) for k in range(x.ndim)])
        shifted = (jax.lax.slice_in_dim(padded, k, k + x.shape[axis], axis=axis) for k in range(len(WINDOW)))
        return sum((float(weight) * image for weight, image in zip(WINDOW, shifted, strict=True)), jnp.zeros_like(x))

    return along(-2, along(-3, images))


_blur = jax.custom_vjp(unfused_on_cpu(_window_mean))
# The blur with a symmetric window is its own transpose; JAX would derive a slow sum of padded images instead.
_blur.defvjp(lambda images: (_blur(images), None), lambda _, cotangent: (_blur(cotangent),))
