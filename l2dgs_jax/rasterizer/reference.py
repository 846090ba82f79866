"""A dense rasterizer to test the fast one against: every Gaussian at every pixel, differentiated by JAX."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from l2dgs_jax.rasterizer.projection import project


def rasterize_dense(
    means: Float[Array, "N 3"],
    quats: Float[Array, "N 4"],
    scales: Float[Array, "N 3"],
    opacities: Float[Array, " N"],
    features: Float[Array, "N C"],
    viewmat: Float[Array, "4 4"],
    K: Float[Array, "3 3"],
    width: int,
    height: int,
) -> tuple[Float[Array, "H W C"], Float[Array, "H W"], Float[Array, "H W"]]:
    """Features, alpha and depth of one view, as `rasterize` defines them, in O(N H W) memory.

    Gradients flow to every array.

    Args:
        means: centres, world units.
        quats: rotations, wxyz, any norm.
        scales: standard deviations along the principal axes, world units.
        opacities: in [0, 1].
        features: channels to blend.
        viewmat: world to camera, OpenCV axes.
        K: intrinsics, pixels.
        width: pixels.
        height: pixels.
    """
    projected = project(means, quats, scales, viewmat, K, width, height)
    channels = jnp.concatenate([features, projected.depths[:, None], jnp.ones_like(opacities)[:, None]], axis=-1)
    order = jnp.argsort(projected.depths)

    x, y = jnp.arange(width).astype(means.dtype) + 0.5, jnp.arange(height).astype(means.dtype) + 0.5
    dx = x[None, None, :] - projected.means2d[order, 0, None, None]
    dy = y[None, :, None] - projected.means2d[order, 1, None, None]
    a, b, c = (projected.conics[order, entry, None, None] for entry in range(3))
    alpha = opacities[order, None, None] * jnp.exp(-0.5 * (a * dx**2 + 2 * b * dx * dy + c * dy**2))
    alpha = jnp.where(alpha > 0.999, 0.999, alpha)
    alpha = jnp.where((alpha < 1 / 255) | ~projected.visible[order, None, None], 0, alpha)

    after = jnp.cumprod(1 - alpha, axis=0)
    before = jnp.concatenate([jnp.ones_like(after[:1]), after[:-1]])
    weights = jnp.where(after <= 1e-4, 0, before * alpha)
    image = jnp.einsum("nhw,nc->hwc", weights, channels[order])
    return image[..., :-2], image[..., -1], image[..., -2]
