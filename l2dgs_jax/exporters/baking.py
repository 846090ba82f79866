"""The well-lit scene at an instant as Gaussians that each have one colour, which is what splat viewers draw.

The well-lit image is a product of two blended images (Eq. 7), and reflectances may lie outside [0, 1]; a viewer blends
once, and takes no colours below 0. So the colours are those in a range whose blend comes closest to the exact images of
some training cameras, in the sense of least squares: a convex problem, as a blend is linear in its colours.
"""

from collections.abc import Iterable, Iterator
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.cameras import select_camera
from l2dgs_jax.config import ModelConfig
from l2dgs_jax.exporters.splats import Splats
from l2dgs_jax.metrics import psnr
from l2dgs_jax.model.deformation import deform, length_unit
from l2dgs_jax.model.rendering import Renderer
from l2dgs_jax.rasterizer import rasterize
from l2dgs_jax.rasterizer.projection import NEAR_PLANE
from l2dgs_jax.runs import Run
from l2dgs_jax.runtime.capacity import next_capacity
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera, MovedGaussians, RasterOutput, Scene

VIEWS = 8  # training cameras that colours are fitted to; they are checked on those halfway between
FIRST_ROUNDS, ROUNDS = 24, 6  # of the fit, at the first instant and at others, which start from the one before
OVERBRIGHT = 1.25  # a brightest colour with which most of what [0, 1] costs is won back; more gains hardly anything
LEAST_WEIGHT = 1e-9  # summed over all pixels; what is seen less keeps its colour

Geometry = tuple[Float[Array, "N 3"], Float[Array, "N 4"], Float[Array, "N 3"], Float[Array, " N"]]


class Baked(NamedTuple):
    """A scene at an instant, and how close its colours come to L and R.

    Attributes:
        splats: every Gaussian of the scene, in the same order at all instants.
        psnr: of their images against the exact ones, dB, mean over training cameras that they were not fitted to.
    """

    splats: Splats
    psnr: float


class _Canvas(NamedTuple):
    """What images are drawn on: their size in pixels, the near plane, and the value where nothing is drawn."""

    width: int
    height: int
    near_plane: float
    background: float


def bake(run: Run, times: Iterable[float], brightest: float = 1.0) -> Iterator[Baked]:
    """The well-lit scene at each of some instants, one after the other.

    The colours are to be blended over black; over white if `model.background` is 1.

    Args:
        run: the run.
        times: instants in [0, 1], best in their order: each starts from the colours of the one before.
        brightest: upper end of the colours' range: 1, or somewhat more (`OVERBRIGHT`) where nothing clips them before
            they are blended.
    """
    scene, cfg, renderer, train = run.state.scene, run.config.model, run.renderer(), run.dataset.train
    near_plane = float(NEAR_PLANE * length_unit(scene.extent, cfg))
    canvas = _Canvas(run.dataset.width, run.dataset.height, near_plane, cfg.background**2)
    views = np.unique(np.linspace(0, len(train.names) - 1, 2 * VIEWS - 1).round().astype(int))
    between = views[1::2] if len(views) > 1 else views
    colors, rounds = None, FIRST_ROUNDS
    for time in times:
        fitted, checked = (_at_instant(train.cameras, chosen, time) for chosen in (views[::2], between))
        moved = _moved(scene, fitted, renderer.sh_degree, cfg=cfg, moving=run.moving)
        geometry = tuple(rows[0] for rows in (moved.means, moved.quats, moved.scales, moved.opacities))
        if colors is None:
            colors = jnp.clip(moved.illumination.mean(0)[:, None] * moved.reflectance[0], 0, brightest)
        _, drawn = _blend(colors, geometry, fitted, canvas)
        room, images = next_capacity(int(drawn.pairs)), _exact(renderer, fitted)
        colors = _fit(colors, geometry, fitted, images, rounds, brightest, canvas=canvas, pair_capacity=room)
        rounds = ROUNDS
        images, _ = _blend(colors, geometry, checked, canvas)
        closeness = psnr(images, _exact(renderer, checked)).mean()
        yield Baked(_splats(geometry, colors, np.asarray(scene.alive)), float(closeness))


@partial(jax.jit, static_argnames=("canvas", "pair_capacity"))
def _fit(
    colors: Float[Array, "N 3"],
    geometry: Geometry,
    cameras: Camera,
    images: Float[Array, "V H W 3"],
    rounds: Int[Array, ""] | int,
    brightest: Float[Array, ""] | float,
    *,
    canvas: _Canvas,
    pair_capacity: int,
) -> Float[Array, "N 3"]:
    """The colours from 0 to `brightest` whose images have the least squared error, by projected gradients (FISTA).

    The weights of a pixel's Gaussians sum to its alpha. With A of these weights, that makes the row sums of A^T A equal
    to A^T alpha, and a step of a Gaussian's own gradient over its row sum never too long.
    """
    blend = partial(_blend, geometry=geometry, cameras=cameras, canvas=canvas, pair_capacity=pair_capacity)
    _, pull, drawn = jax.vjp(blend, colors, has_aux=True)
    (row_sums,) = pull(jnp.broadcast_to(drawn.alpha[..., None], images.shape))

    def step(count: Int[Array, ""], state: tuple[Array, Array]) -> tuple[Array, Array]:
        last, ahead = state
        (gradient,) = pull(blend(ahead)[0] - images)
        new = jnp.clip(ahead - gradient / jnp.maximum(row_sums, LEAST_WEIGHT), 0, brightest)
        momentum = count.astype(new.dtype) / (count + 3).astype(new.dtype)
        return new, new + momentum * (new - last)

    return jax.lax.fori_loop(0, rounds, step, (colors, colors))[0]


def _blend(
    colors: Float[Array, "N 3"],
    geometry: Geometry,
    cameras: Camera,
    canvas: _Canvas,
    pair_capacity: int | None = None,
) -> tuple[Float[Array, "V H W 3"], RasterOutput]:
    """The images that a viewer of splats shows, and what else was drawn; gradients flow to the colours."""
    drawn = rasterize(
        *geometry,
        colors,
        cameras.viewmat,
        cameras.K,
        canvas.width,
        canvas.height,
        near_plane=canvas.near_plane,
        pair_capacity=pair_capacity,
    )
    return drawn.features + canvas.background * (1 - drawn.alpha[..., None]), drawn


@partial(jax.jit, static_argnames=("cfg", "moving"))
def _moved(
    scene: Scene, cameras: Camera, sh_degree: Int[Array, ""] | int, *, cfg: ModelConfig, moving: bool
) -> MovedGaussians:
    return deform(scene, cameras, cfg, moving=moving, sh_degree_active=sh_degree)


def _exact(renderer: Renderer, cameras: Camera) -> Float[Array, "V H W 3"]:
    """The well-lit images of Eq. 7."""
    views = range(len(cameras.time))
    return jnp.stack(list(prefetch(lambda i: renderer.welllit(select_camera(cameras, i)), views)))


def _at_instant(cameras: Camera, chosen: Int[np.ndarray, " V"], time: float) -> Camera:
    """Some of the cameras, all at one instant."""
    viewmat, K = (jnp.asarray(x[chosen], float) for x in (cameras.viewmat, cameras.K))
    return Camera(viewmat, K, jnp.full(len(chosen), time, float))


def _splats(geometry: Geometry, colors: Float[Array, "N 3"], alive: Bool[np.ndarray, " N"]) -> Splats:
    splats = Splats(*(np.asarray(rows, np.float32)[alive] for rows in (*geometry, colors)))
    norms = np.linalg.norm(splats.quats, axis=-1, keepdims=True)
    identity = np.array([[1, 0, 0, 0]], np.float32)
    return splats._replace(quats=np.divide(splats.quats, norms, out=identity.repeat(len(norms), 0), where=norms > 0))
