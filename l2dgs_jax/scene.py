"""A scene's initial state, its capacity, and the names of its parameter groups."""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray, Shaped
from scipy.spatial import cKDTree

from l2dgs_jax import hexplane, networks
from l2dgs_jax.config import ModelConfig
from l2dgs_jax.data.stacks import pixel_mean, stacked
from l2dgs_jax.threads import in_order
from l2dgs_jax.types import Camera, Gaussians, Scene, SceneParams

SH_DC = 0.28209479177387814  # value of the first SH basis function
LUMINANCE = np.array([0.2989, 0.587, 0.114])
SEEN_AT_ONCE = 2**26  # colour values of points that `observed_colors` holds in memory

GAUSSIAN_GROUPS: dict[str, Any] = {
    "means": "means",
    "quats": "quats",
    "log_scales": "scales",
    "logit_opacities": "opacities",
    "illumination_dc": "illumination",
    "illumination_rest": "illumination_rest",
    "reflectance": "reflectance",
    "attenuation": "attenuation",
}


def rung(count: float | int, *, base: int = 1024) -> int:
    """The smallest size >= `count` on the ladder base, 1.5 base, 1.5^2 base ... (multiples of 256).

    Static sizes are taken from it, so that growing work recompiles a logarithmic number of times.
    """
    size = base
    while size < count:
        size = -(-size * 3 // 512) * 256
    return size


def z_order(points: np.ndarray) -> np.ndarray:
    """The order of points [P 3] along a Z-order curve (Morton, 1966).

    What lies close in space then mostly lies close in memory, and looking up its features finds them in a cache.
    """
    bits = 10
    low, span = points.min(0), max(float(np.ptp(points, axis=0).max()), 1e-30)
    cells = ((points - low) / span * (2**bits - 1)).astype(np.int64)
    places = (((cells[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(bits) for axis in range(3))
    return np.argsort(sum(places), kind="stable")


def camera_extent(cameras: Camera) -> float:
    """1.1 times the largest distance of a camera centre from their mean, world units (as 3DGS and 4DGS)."""
    viewmat = np.asarray(cameras.viewmat, np.float64)
    centres = -np.einsum("fji,fj->fi", viewmat[:, :3, :3], viewmat[:, :3, 3])
    return float(1.1 * np.linalg.norm(centres - centres.mean(0), axis=-1).max())


def initialise(
    key: PRNGKeyArray,
    points: np.ndarray,
    colors: np.ndarray | None,
    cameras: Camera,
    cfg: ModelConfig,
    capacity: int,
    reflectance: np.ndarray | None = None,
) -> Scene:
    """A scene with one Gaussian a point, ready for training.

    Scales are the root mean square distance to the three nearest points, illumination the luminance of the point
    (mid-grey without colours) unless `cfg.initial_illumination` says otherwise, opacity `cfg.initial_opacity`,
    reflectance and attenuation random (paper, section 4).

    Args:
        key: randomness of reflectance, attenuation, planes and networks.
        points: [P 3] world units, P <= capacity.
        colors: [P 3] sRGB in [0, 1], or None.
        cameras: the training cameras, [F]; their number sets the time resolution, their spread the extent.
        cfg: shape and initial state.
        capacity: rows to allocate; those past P are dead.
        reflectance: [P 3] initial reflectance, for `cfg.reflectance_init` "observed".
    """
    count = len(points)
    distances, _ = cKDTree(points).query(points, k=min(4, count))
    mean_square = np.square(distances[:, 1:]).mean(-1) if count > 1 else np.ones(count)
    if cfg.initial_illumination is not None:
        illumination = np.full(count, cfg.initial_illumination)
    else:
        illumination = np.full(count, 0.5) if colors is None else np.asarray(colors) @ LUMINANCE
    return _initialise(
        key,
        jnp.asarray(points, float),
        jnp.asarray(0.5 * np.log(np.maximum(mean_square, 1e-7)), float),
        jnp.asarray(illumination, float),
        None if reflectance is None else jnp.asarray(reflectance, float),
        jnp.asarray(camera_extent(cameras), float),
        cfg,
        len(cameras.time),
        capacity,
    )


@partial(jax.jit, static_argnames=("cfg", "num_frames", "capacity"))
def _initialise(
    key: PRNGKeyArray,
    points: Float[Array, "P 3"],
    log_scales: Float[Array, " P"],
    illumination: Float[Array, " P"],
    reflectance: Float[Array, "P 3"] | None,
    extent: Float[Array, ""],
    cfg: ModelConfig,
    num_frames: int,
    capacity: int,
) -> Scene:
    count = len(points)
    keys = jax.random.split(key, 6)
    random = {"normal": jax.random.normal, "uniform": jax.random.uniform}
    gaussians = Gaussians(
        means=points,
        quats=jnp.tile(jnp.array([[1.0, 0.0, 0.0, 0.0]]), (count, 1)),
        log_scales=jnp.tile(log_scales[:, None], (1, 3)),
        logit_opacities=jnp.full(count, jax.scipy.special.logit(cfg.initial_opacity), points.dtype),
        illumination_dc=(illumination - cfg.illumination_offset)[:, None] / SH_DC,
        illumination_rest=jnp.zeros((count, (cfg.sh_degree + 1) ** 2 - 1)),
        reflectance=random[cfg.reflectance_init](keys[0], (count, 3)) if reflectance is None else reflectance,
        attenuation=random[cfg.attenuation_init](keys[1], (count, 2)),
    )
    params = SceneParams(
        gaussians=jax.tree.map(lambda rows: pad_rows(rows, capacity), gaussians),
        hexplane=hexplane.init(keys[2], cfg, num_frames),
        heads=networks.init_heads(keys[3], cfg.plane_channels * len(cfg.plane_scales), cfg),
        ocd=networks.init_ocd(keys[4], cfg),
        bafe=networks.init_bafe(keys[5], cfg),
    )
    return Scene(
        params=params,
        alive=jnp.arange(capacity) < count,
        bounds=jnp.stack([points.min(0), points.max(0)]),
        extent=extent,
    )


def observed_colors(
    points: Float[np.ndarray, "P 3"],
    cameras: Camera,
    images: Float[np.ndarray, "F H W 3"],
    valid: Bool[np.ndarray, "F H W"] | None = None,
) -> Float[np.ndarray, "P 3"]:
    """Median colour of the pixels that each point projects to, occlusion ignored; the mean where none are.

    Memory is bounded whatever the numbers of frames and points: colours that take much lie in a temporary file.

    Args:
        points: world units.
        cameras: F cameras.
        images: their images, sRGB in [0, 1].
        valid: which pixels count; None for all.
    """
    height, width = images.shape[1:3]

    def seen_in(frame: int) -> Float[np.ndarray, "P 3"]:
        """Colours of the points, NaN where they are not to be seen."""
        viewmat, K, image = np.asarray(cameras.viewmat[frame]), cameras.K[frame], images[frame]
        x, y, z = K @ (viewmat[:3, :3] @ points.T + viewmat[:3, 3:])
        depth = np.where(z > 0, z, np.inf)
        column, row = np.floor(x / depth).astype(int), np.floor(y / depth).astype(int)
        inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        if valid is not None:
            inside[inside] = valid[frame][row[inside], column[inside]]
        colors = np.full((len(points), 3), np.nan, images.dtype)
        colors[inside] = image[row[inside], column[inside]]
        return colors

    shape = (len(images), len(points), 3)
    seen = stacked(in_order(seen_in, range(len(images))), shape, images.dtype, in_file=math.prod(shape) > SEEN_AT_ONCE)
    some = max(SEEN_AT_ONCE // (3 * len(images)), 1)
    parts = [_median(seen[:, start : start + some].astype(np.float32)) for start in range(0, len(points), some)]
    colors = np.concatenate(parts)
    return np.where(np.isnan(colors).all(-1, keepdims=True), pixel_mean(images, valid).astype(colors.dtype), colors)


def _median(seen: Float[np.ndarray, "F P 3"]) -> Float[np.ndarray, "P 3"]:
    """Median over the frames, without those that are NaN."""
    last = np.count_nonzero(~np.isnan(seen), axis=0, keepdims=True) - 1
    seen = np.sort(seen, axis=0)  # NaN last
    return np.take_along_axis(seen, np.concatenate([last // 2, (last + 1) // 2]), axis=0).mean(0)


def groups(params: SceneParams) -> SceneParams:
    """The learning-rate group of every leaf of `params`, by name (see `optim.schedules`)."""
    label = lambda name, tree: jax.tree.map(lambda _: name, tree)
    return params._replace(
        gaussians=Gaussians(**GAUSSIAN_GROUPS),
        hexplane=label("planes", params.hexplane),
        heads=label("heads", params.heads),
        ocd=label("ocd", params.ocd),
        bafe=label("bafe", params.bafe),
    )


def pad_rows(rows: Shaped[Array, "N ..."], capacity: int) -> Shaped[Array, "M ..."]:
    """Append zero rows up to `capacity`."""
    return jnp.pad(rows, [(0, capacity - rows.shape[0])] + [(0, 0)] * (rows.ndim - 1))
