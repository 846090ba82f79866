"""Scene, camera, instant -> images: the one function that training and every tool call."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.model import channels
from l2dgs_jax.model.decomposition import decompose
from l2dgs_jax.model.deformation import deform, length_unit
from l2dgs_jax.model.tone_curves import darkened
from l2dgs_jax.rasterizer import rasterize
from l2dgs_jax.rasterizer.rasterization import LEAST_ALPHA, NEAR_PLANE
from l2dgs_jax.runtime.capacity import next_capacity
from l2dgs_jax.types import Camera, RenderOutput, Scene

Drawn = TypeVar("Drawn", "RenderOutput", "_WellLit")


def render(
    scene: Scene,
    cameras: Camera,
    cfg: ModelConfig,
    width: int,
    height: int,
    *,
    moving: bool,
    sh_degree: Int[Array, ""] | int,
    pair_capacity: int | None,
    means2d_probe: Float[Array, "V N 2"] | None = None,
    presence: Float[Array, " N"] | None = None,
) -> RenderOutput:
    """Render V views, each at its own instant (Eqs. 1-9).

    Gradients flow to every leaf of `scene.params` and to `means2d_probe`.

    Args:
        scene: the scene.
        cameras: V cameras.
        cfg: shape of the scene.
        width: pixels.
        height: pixels.
        moving: whether motion field and OCD-Net are active (fine stage).
        sh_degree: SH bands in use, 0 ... cfg.sh_degree.
        pair_capacity: size of the rasterizer's pair buffer for all views; None only outside jit.
        means2d_probe: zeros whose gradient is dL/d(mean2d) in pixels.
        presence: see `deform`.
    """
    moved = deform(scene, cameras, cfg, moving=moving, sh_degree_active=sh_degree, presence=presence)
    drawn = rasterize(
        moved.means,
        moved.quats,
        moved.scales,
        moved.opacities,
        channels.pack(moved.illumination, moved.reflectance, moved.attenuation),
        cameras.viewmat,
        cameras.K,
        width,
        height,
        near_plane=NEAR_PLANE * length_unit(scene.extent, cfg),
        means2d_probe=means2d_probe,
        pair_capacity=pair_capacity,
    )
    features = drawn.features
    if cfg.background:
        filled = channels.HAS_BACKGROUND[None, None, None]
        features = features + cfg.background * jnp.where(filled, 1 - drawn.alpha[..., None], 0)
    images, curves = decompose(features, scene.params.bafe, cfg), scene.params.curves
    if curves is not None:
        shared = jnp.broadcast_to(curves.shared[None], (len(features), *curves.shared.shape))
        images = images._replace(lowlight=darkened(images.welllit, shared))
    return RenderOutput(
        images=images,
        alpha=drawn.alpha,
        depth=drawn.depth,
        radii=drawn.radii,
        pairs=drawn.pairs,
        overflow=drawn.overflow,
    )


class Renderer:
    """Renders views of one scene outside jit, one at a time, growing the pair buffer when a view overflows it."""

    def __init__(self, scene: Scene, cfg: ModelConfig, width: int, height: int, *, moving: bool, sh_degree: int):
        self.scene, self.cfg, self.width, self.height = scene, cfg, width, height
        self.moving, self.sh_degree = moving, sh_degree
        self.pair_capacity = next_capacity(4 * scene.alive.shape[0])

    def __call__(self, camera: Camera) -> RenderOutput:
        """Render one camera (no batch axis); the output has none either."""
        output = self._without_overflow(_render, camera)
        images = jax.tree.map(lambda x: x[0], output.images)
        return output._replace(images=images, alpha=output.alpha[0], depth=output.depth[0], radii=output.radii[0])

    def welllit(self, camera: Camera) -> Float[Array, "H W 3"]:
        """Only I_w of one camera: without the low-light image, no exponents are needed."""
        return self._without_overflow(_render_welllit, camera).image[0]

    def _without_overflow(self, draw: Callable[..., Drawn], camera: Camera) -> Drawn:
        cameras = jax.tree.map(lambda x: jnp.asarray(x, float)[None], camera)
        while True:
            output = draw(
                self.scene,
                cameras,
                cfg=self.cfg,
                width=self.width,
                height=self.height,
                moving=self.moving,
                sh_degree=self.sh_degree,
                pair_capacity=self.pair_capacity,
            )
            if not output.overflow:
                return output
            self.pair_capacity = next_capacity(1.2 * float(output.pairs))


class _WellLit(NamedTuple):
    image: Float[Array, "V H W 3"]
    pairs: Int[Array, ""]
    overflow: Bool[Array, ""]


_STATIC = ("cfg", "width", "height", "moving", "pair_capacity")
_render = partial(jax.jit, static_argnames=_STATIC)(render)


@partial(jax.jit, static_argnames=_STATIC)
def _render_welllit(*arguments: Any, **options: Any) -> _WellLit:
    output = render(*arguments, **options)
    return _WellLit(output.images.welllit, output.pairs, output.overflow)


def expected_depth(output: RenderOutput) -> Float[np.ndarray, "H W"]:
    """Mean depth along each ray, world units: depth / alpha, and 0 where nothing is drawn."""
    return np.asarray(output.depth) / np.maximum(np.asarray(output.alpha), LEAST_ALPHA)
