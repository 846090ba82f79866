"""Pixels of points and rays of pixels, how cameras lie and spread, and cameras made from others."""

from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.spatial.transform import Rotation, Slerp

from l2dgs_jax.types import Camera

AnyArray = TypeVar("AnyArray", Array, np.ndarray)

OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenCV's camera axes (right, down, forward) to (right, up, back)


def camera_centres(viewmats: AnyArray) -> AnyArray:
    """Centres [*B 3] of cameras in world units, of rigid `viewmats` [*B 4 4]; carries gradients."""
    # Sums of products instead of a matrix product, which accelerators compute at reduced precision.
    return -(viewmats[..., :3, :3] * viewmats[..., :3, 3:]).sum(-2)


def project_points(
    points: Float[np.ndarray, "*B 3"], viewmats: Float[np.ndarray, "*C 4 4"], Ks: Float[np.ndarray, "*C 3 3"]
) -> tuple[Float[np.ndarray, "*B 2"], Float[np.ndarray, "*B"]]:
    """Pixels of points in world units, NaN behind the camera, and their depths; one camera, or one for each point."""
    local = np.einsum("...ij,...j->...i", viewmats[..., :3, :3], points) + viewmats[..., :3, 3]
    depth = local[..., 2]
    seen = np.einsum("...ij,...j->...i", Ks[..., :2, :], local)
    return seen / np.where(depth > 0, depth, np.nan)[..., None], depth


def pixel_rays(
    pixels: Float[np.ndarray, "N 2"], viewmats: Float[np.ndarray, "*C 4 4"], Ks: Float[np.ndarray, "*C 3 3"]
) -> Float[np.ndarray, "N 3"]:
    """From the camera to what a pixel shows at depth 1, in world axes; one camera, or one for each pixel."""
    homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=-1)
    local = np.einsum("...ij,...j->...i", np.linalg.inv(Ks), homogeneous)
    return np.einsum("...ji,...j->...i", viewmats[..., :3, :3], local)


def points_inside(
    points: Float[np.ndarray, "P 3"],
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, ...],
) -> tuple[Bool[np.ndarray, " P"], Float[np.ndarray, "S 2"], Float[np.ndarray, " S"]]:
    """Which points (world units) project into an image of that width and height, and the pixels and depths of those.

    Occlusion is ignored.
    """
    pixels, depth = project_points(points, viewmat, K)
    inside: np.ndarray = np.all((pixels >= 0) & (pixels < size), axis=-1)  # not where they are NaN
    return inside, pixels[inside], depth[inside]


def mean_up(viewmats: Float[np.ndarray, "F 4 4"]) -> Float[np.ndarray, "3"]:
    """The unit vector that cameras hold upwards on average; the first camera's if they do not agree at all."""
    ups = -np.asarray(viewmats[:, 1, :3], np.float64)
    mean = ups.mean(0)
    length = np.linalg.norm(mean)
    return mean / length if length > 1e-6 else ups[0]


def camera_extent(cameras: Camera) -> float:
    """1.1 times the largest distance of a camera centre from their mean, world units (as 3DGS and 4DGS)."""
    centres = camera_centres(np.asarray(cameras.viewmat, np.float64))
    return float(1.1 * np.linalg.norm(centres - centres.mean(0), axis=-1).max())


def median_depth(cameras: Camera, points: Float[np.ndarray, "P 3"]) -> float:
    """Median over the cameras of the median depth of the points in front of each, world units.

    Raises:
        ValueError: no point lies in front of a camera.
    """
    viewmats = np.asarray(cameras.viewmat, np.float64)
    depths = [points @ viewmat[2, :3] + viewmat[2, 3] for viewmat in viewmats]
    medians = [np.median(depth[depth > 0]) for depth in depths if (depth > 0).any()]
    if not medians:
        raise ValueError("no point lies in front of a camera")
    return float(np.median(medians))


def select_camera(cameras: Camera, index: int) -> Camera:
    """One camera of a batch."""
    return Camera(*(x[index] for x in cameras))


def between(cameras: Camera, first: int, second: int, part: float) -> Camera:
    """A camera `part` of the way from one of a batch to another, in NumPy arrays of the batch's type.

    Its centre, intrinsics and time are weighted means; its orientation is interpolated spherically (slerp).
    """
    viewmats = np.asarray(cameras.viewmat, np.float64)[[first, second]]
    weights = np.array([1 - part, part])
    rotation = Slerp([0, 1], Rotation.from_matrix(viewmats[:, :3, :3]))(part).as_matrix()
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ (weights @ camera_centres(viewmats))
    K, time = (np.tensordot(weights, np.asarray(x, np.float64)[[first, second]], 1) for x in (cameras.K, cameras.time))
    return Camera(*(np.asarray(x, cameras.viewmat.dtype) for x in (viewmat, K, time)))  # type: ignore[arg-type]


def resize(camera: Camera, factor: float | int) -> Camera:
    """The same view in an image `factor` times as wide and as high; exact, because pixel centres lie at +0.5.

    Args:
        camera: one camera, or a batch of them.
        factor: on the width and the height in pixels.
    """
    scale: Float[np.ndarray, "3 1"] = np.array([[factor], [factor], [1.0]])
    K = jnp.asarray(camera.K)
    return camera._replace(K=K * jnp.asarray(scale, K.dtype).reshape(*[1] * (K.ndim - 2), 3, 1))


def reframe(cameras: Camera, size: tuple[int, int], wanted: tuple[int, int]) -> Camera:
    """Cameras of images of one size, for images of another: enlarged or reduced until they fill it, the rest cut off.

    Args:
        cameras: one camera, or a batch of them.
        size: width and height of their images, pixels.
        wanted: width and height of the images that they are to have, pixels.
    """
    factor = max(new / old for new, old in zip(wanted, size, strict=True))
    margins = [(new - factor * old) / 2 for new, old in zip(wanted, size, strict=True)]
    K = np.array(resize(cameras, factor).K)
    K[..., :2, 2] += np.asarray(margins, K.dtype)
    return cameras._replace(K=K)  # type: ignore[arg-type]
