"""Baking the well-lit scene at an instant into Gaussians with one colour each, which is what splat viewers draw.

The well-lit image is a product of two blended images (Eq. 7), and reflectances may lie outside [0, 1]. A viewer blends
only once, and accepts no colours below 0. So colours within a range are fitted by least squares, so that their blend
matches the exact images of some training cameras. This is a convex problem, because a blend is linear in its colours.
Colours that show the estimates of the dark frames (Eq. 9) are fitted likewise.
"""

from collections.abc import Iterable, Iterator
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from l2dgs_jax.cameras import select_camera
from l2dgs_jax.config import ModelConfig
from l2dgs_jax.data.stacks import evenly_spread
from l2dgs_jax.exporters.splats import Splats
from l2dgs_jax.metrics import psnr
from l2dgs_jax.model.decomposition import as_light, full_light, product
from l2dgs_jax.model.deformation import deform, length_unit
from l2dgs_jax.model.rendering import Renderer
from l2dgs_jax.rasterizer import rasterize
from l2dgs_jax.rasterizer.projection import NEAR_PLANE
from l2dgs_jax.runs import Run
from l2dgs_jax.runtime.capacity import next_capacity
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera, MovedGaussians, RasterOutput, Scene

FITTED_VIEWS = 8  # training cameras that colours are fitted to; the fit is checked on cameras halfway between them
FIRST_ITERATIONS, ITERATIONS = 24, 6  # of the fit: at the first instant, and at others, which start from the one before
OVERBRIGHT = 1.25  # upper limit of colours that recovers most of the loss due to [0, 1]; a higher one hardly helps
LEAST_WEIGHT = 1e-9  # sum of a Gaussian's weights over all pixels; a Gaussian with less keeps its colour

Image = Literal["welllit", "lowlight"]
Geometry = tuple[Float[Array, "N 3"], Float[Array, "N 4"], Float[Array, "N 3"], Float[Array, " N"]]


class _Canvas(NamedTuple):
    """Parameters for drawing images: size in pixels, near plane, and the value where nothing is drawn."""

    width: int
    height: int
    near_plane: float
    background: float


def bake(
    run: Run, times: Iterable[float], brightest: float = 1.0, images: tuple[Image, ...] = ("welllit",)
) -> Iterator[tuple[Splats, ...]]:
    """The scene at each of several instants, one after the other: all Gaussians, always in the same order.

    The colours are meant to be blended over black, or over white if `model.background` is 1.

    Args:
        run: the run.
        times: instants in [0, 1], preferably in order, because each fit starts from the colours of the one before.
        brightest: upper limit of the colours: 1, or somewhat more (`OVERBRIGHT`) if nothing clips them before they are
            blended.
        images: the kinds of image to fit colours to, "welllit" first; the result has Gaussians for each, which differ
            only in their colours.
    """
    scene, cfg, renderer, canvas = run.state.scene, run.config.model, run.renderer(), _canvas(run)
    colors, iterations = None, FIRST_ITERATIONS
    for time in times:
        cameras = _at_instant(run, time, slice(0, None, 2))
        moved = _moved(scene, cameras, renderer.sh_degree, cfg=cfg, moving=run.moving)
        geometry = tuple(rows[0] for rows in (moved.means, moved.quats, moved.scales, moved.opacities))
        exact = _exact(renderer, cameras, images)
        if colors is None:
            levels = exact.mean((0, 1, 2))
            light = moved.illumination.mean(0) / full_light(cfg)
            own = product(light, as_light(jnp.clip(moved.reflectance[0], 0, 1), cfg), cfg)
            colors = jnp.clip(jnp.tile(own, len(images)) * _gains(levels)[None], 0, brightest)
        _, drawn = _blend(colors, geometry, cameras, canvas)
        room = next_capacity(int(drawn.pairs))
        colors = _fit(colors, geometry, cameras, exact, iterations, brightest, canvas=canvas, pair_capacity=room)
        iterations = ITERATIONS
        yield _splats(geometry, colors, np.asarray(scene.alive))


def closeness(run: Run, splats: Splats, time: float, image: Image = "welllit") -> float:
    """PSNR of the images of baked Gaussians against the exact ones at an instant, dB.

    It is the mean over training cameras halfway between those that `bake` fits colours to.
    """
    cameras = _at_instant(run, time, slice(1, None, 2))
    means, quats, scales, opacities, colors = (jnp.asarray(rows, float) for rows in splats)
    shown, _ = _blend(colors, (means, quats, scales, opacities), cameras, _canvas(run))
    return float(psnr(shown, _exact(run.renderer(), cameras, (image,))).mean())


@partial(jax.jit, static_argnames=("canvas", "pair_capacity"))
def _fit(
    colors: Float[Array, "N C"],
    geometry: Geometry,
    cameras: Camera,
    images: Float[Array, "V H W C"],
    iterations: Int[Array, ""] | int,
    brightest: Float[Array, ""] | float,
    *,
    canvas: _Canvas,
    pair_capacity: int,
) -> Float[Array, "N C"]:
    """The colours in [0, `brightest`] whose images have the least squared error, by projected gradients (FISTA).

    Let A be the matrix of the blending weights of all pixels. A pixel's weights sum to its alpha, so the row sums of
    A^T A are A^T alpha. Dividing each Gaussian's gradient by its row sum gives a step that is never too long.
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

    return jax.lax.fori_loop(0, iterations, step, (colors, colors))[0]


def _blend(
    colors: Float[Array, "N C"],
    geometry: Geometry,
    cameras: Camera,
    canvas: _Canvas,
    pair_capacity: int | None = None,
) -> tuple[Float[Array, "V H W C"], RasterOutput]:
    """The images that a splat viewer shows, and the rasterizer's output; gradients flow to the colours."""
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


def near_plane(run: Run) -> float:
    """Depth beyond which Gaussians are drawn, world units."""
    return float(NEAR_PLANE * length_unit(run.state.scene.extent, run.config.model))


def background(run: Run) -> float:
    """Background to blend the colours over, sRGB: the value of the well-lit image where nothing is drawn."""
    model = run.config.model
    if model.decomposition != "retinex":
        return model.background
    color = as_light(jnp.full(3, model.background, float), model)
    return float(product(jnp.asarray(model.background / full_light(model), float), color, model)[0])


def _exact(renderer: Renderer, cameras: Camera, kinds: tuple[Image, ...]) -> Float[Array, "V H W C"]:
    """The exact images of these kinds (Eqs. 7 and 9), their channels concatenated."""

    def draw(camera: Camera) -> Float[Array, "H W C"]:
        if kinds == ("welllit",):
            return renderer.welllit(camera)
        images = renderer(camera).images
        return jnp.concatenate([getattr(images, kind) for kind in kinds], axis=-1)

    views = range(len(cameras.time))
    return jnp.stack(list(prefetch(lambda i: draw(select_camera(cameras, i)), views)))


def _gains(levels: Float[Array, " C"]) -> Float[Array, " C"]:
    """Mean brightness of each image over that of the first, repeated for its channels."""
    means = levels.reshape(-1, 3).mean(-1)
    return jnp.repeat(means / jnp.maximum(means[:1], LEAST_WEIGHT), 3)


def _canvas(run: Run) -> _Canvas:
    return _Canvas(run.dataset.width, run.dataset.height, near_plane(run), background(run))


def _at_instant(run: Run, time: float, every_other: slice) -> Camera:
    """Training cameras, spread evenly over all of them, set to one instant; `every_other` picks those to use."""
    cameras = run.dataset.train.cameras
    spread = evenly_spread(len(cameras.time), 2 * FITTED_VIEWS - 1)
    chosen = spread[every_other] if len(spread) > 1 else spread
    viewmat, K = (jnp.asarray(x[chosen], float) for x in (cameras.viewmat, cameras.K))
    return Camera(viewmat, K, jnp.full(len(chosen), time, float))


def _splats(geometry: Geometry, colors: Float[Array, "N C"], alive: Bool[np.ndarray, " N"]) -> tuple[Splats, ...]:
    means, quats, scales, opacities, shown = (np.asarray(rows, np.float32)[alive] for rows in (*geometry, colors))
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    identity = np.array([[1, 0, 0, 0]], np.float32)
    quats = np.divide(quats, norms, out=identity.repeat(len(norms), 0), where=norms > 0)
    return tuple(
        Splats(means, quats, scales, opacities, of_image) for of_image in np.split(shown, shown.shape[1] // 3, 1)
    )
