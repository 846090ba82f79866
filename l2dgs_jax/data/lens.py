"""Lens distortion: its models, and undistorting and distorting pictures."""

import functools
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped


class Lens(NamedTuple):
    """A distortion in normalised image coordinates; the default is a pinhole camera, without distortion.

    Attributes:
        radial: (k1, k2 ...) of the factor on the radius, 1 + k1 s + k2 s^2 ...; s is the squared radius r^2 or, for a
            fisheye, the squared angle theta^2 to the axis.
        divisor: (k4, k5, k6) of such a polynomial by which the factor is divided, as in OpenCV's rational model.
        tangential: (p1, p2) of the Brown-Conrady model.
        fisheye: equidistant projection (OpenCV's fisheye, Kannala-Brandt): the factor also contains theta / r.
    """

    radial: tuple[float, ...] = ()
    divisor: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    fisheye: bool = False

    @property
    def is_pinhole(self) -> bool:
        """Whether nothing is distorted."""
        return not (self.fisheye or any((*self.radial, *self.divisor, *self.tangential)))


def distort(
    lens: Lens, x: Float[np.ndarray, "*S"], y: Float[np.ndarray, "*S"]
) -> tuple[Float[np.ndarray, "*S"], Float[np.ndarray, "*S"]]:
    """Normalised image coordinates at which the lens images the directions (x, y, 1)."""
    r2 = x**2 + y**2
    if lens.fisheye:
        r = np.sqrt(r2)
        theta = np.arctan(r)
        factor = np.where(r > 1e-8, theta / np.maximum(r, 1e-8), 1).astype(r.dtype) * _polynomial(lens.radial, theta**2)
    else:
        factor = _polynomial(lens.radial, r2)
    if lens.divisor:
        factor = factor / _polynomial(lens.divisor, r2)
    p1, p2 = lens.tangential
    return (
        x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * factor + 2 * p2 * x * y + p1 * (r2 + 2 * y**2),
    )


def undistort(
    image: Float32[np.ndarray, "H W C"], K: Float[np.ndarray, "3 3"], lens: Lens, nearest: bool = False
) -> Float32[np.ndarray, "H W C"]:
    """The picture that the pinhole camera `without_skew(K)` would have taken.

    Pixels outside the original picture repeat the nearest one in it.

    Args:
        image: as taken through the lens.
        K: intrinsics of `image`, skew included.
        lens: its distortion.
        nearest: whether to take the value of the nearest pixel, for values that must not be mixed, instead of cubic
            interpolation, which is for values in [0, 1].
    """
    if lens.is_pinhole and K[0, 1] == 0:
        return image
    columns, rows = _cubic_positions(image.shape[1], image.shape[0], tuple(K[:2].ravel().tolist()), lens)
    if nearest:  # the correction for cubic interpolation does not change which pixel is nearest
        return cv2.remap(image, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE).reshape(image.shape)
    warped = cv2.remap(image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(warped.reshape(image.shape), 0, 1)  # cubic interpolation overshoots


def seen(size: tuple[int, int], K: Float[np.ndarray, "3 3"], lens: Lens) -> Bool[np.ndarray, "H W"] | None:
    """Where the result of `undistort` lies inside the original picture, and not mirrored; None if everywhere.

    Beyond some radius, the polynomial of a barrel distortion comes back to the middle, where no lens does.

    Args:
        size: width and height in pixels.
        K: intrinsics of a picture of this size, skew included.
        lens: its distortion.
    """
    if lens.is_pinhole and K[0, 1] == 0:
        return None
    return _seen(*size, tuple(K[:2].ravel().tolist()), lens)


def distorted(image: Shaped[np.ndarray, "H W"], K: Float[np.ndarray, "3 3"], lens: Lens) -> Shaped[np.ndarray, "H W"]:
    """The inverse of `undistort`: what the lens makes of an undistorted picture, by nearest pixels.

    Args:
        image: of the pinhole camera `without_skew(K)`.
        K: intrinsics, skew included.
        lens: its distortion.
    """
    if lens.is_pinhole and K[0, 1] == 0:
        return image
    columns, rows = _undistorted_positions(image.shape[1], image.shape[0], tuple(K[:2].ravel().tolist()), lens)
    return cv2.remap(image, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)


def scale_intrinsics(K: Float[np.ndarray, "3 3"], factor: int) -> Float[np.ndarray, "3 3"]:
    """Intrinsics of a picture shrunk by `factor`; exact because pixel centres lie at +0.5."""
    return K / np.array([[factor], [factor], [1]])


def without_skew(K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Intrinsics of the pictures that `undistort` returns."""
    return np.where(np.arange(9).reshape(3, 3) == 1, 0.0, K)


def _polynomial(coefficients: tuple[float, ...], s: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
    """1 + k1 s + k2 s^2 + ..."""
    value = np.zeros_like(s)
    for coefficient in reversed(coefficients):
        value = (value + coefficient) * s
    return 1 + value


@functools.lru_cache(maxsize=4)  # most scenes have one camera
def _cubic_positions(
    width: int, height: int, K: tuple[float, ...], lens: Lens
) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """`_distorted_positions` as cv2's cubic interpolation needs them (see `_for_cubic`)."""
    columns, rows = _distorted_positions(width, height, K, lens)
    return _for_cubic(columns, width), _for_cubic(rows, height)


@functools.lru_cache(maxsize=4)
def _seen(width: int, height: int, K: tuple[float, ...], lens: Lens) -> Bool[np.ndarray, "H W"] | None:
    columns, rows = _distorted_positions(width, height, K, lens)
    # Up to the edges of the outermost pixels; false for NaN.
    inside = (columns >= -0.5) & (columns <= width - 0.5) & (rows >= -0.5) & (rows <= height - 0.5)
    radius = np.hypot(*_directions(width, height, K))
    inside &= radius < _fold(lens, float(radius.max()))
    return None if inside.all() else inside


def _fold(lens: Lens, reach: float) -> float:
    """The radius, up to `reach`, from which on the lens images directions nearer to the middle again, or infinity."""
    radii = np.linspace(0, reach, 4096)
    with np.errstate(all="ignore"):
        imaged, _ = distort(lens._replace(tangential=(0.0, 0.0)), radii, 0 * radii)
        folds = np.flatnonzero(~(np.diff(imaged) > 0))
    return float(radii[folds[0]]) if len(folds) else np.inf


def _distorted_positions(
    width: int, height: int, K: tuple[float, ...], lens: Lens
) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """For each pixel of the undistorted picture, its column and row in the distorted one; pixel 0 is centred at 0."""
    fx, skew, cx, _, fy, cy = K
    x, y = _directions(width, height, K)
    with np.errstate(all="ignore"):  # a nonsensical lens gives positions outside the picture
        lens_x, lens_y = distort(lens, *np.broadcast_arrays(x, y))
        return fx * lens_x + skew * lens_y + cx - 0.5, fy * lens_y + cy - 0.5


def _directions(
    width: int, height: int, K: tuple[float, ...]
) -> tuple[Float32[np.ndarray, "1 W"], Float32[np.ndarray, "H 1"]]:
    """Normalised image coordinates of the undistorted picture's pixels."""
    fx, _, cx, _, fy, cy = K
    x = ((np.arange(width) + 0.5 - cx)[None, :] / fx).astype(np.float32)  # exact to 1/1000 pixel; twice as fast
    return x, ((np.arange(height) + 0.5 - cy)[:, None] / fy).astype(np.float32)


@functools.lru_cache(maxsize=4)
def _undistorted_positions(
    width: int, height: int, K: tuple[float, ...], lens: Lens
) -> tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]:
    """For each pixel of the distorted picture, its column and row in the undistorted one; pixel 0 is centred at 0."""
    fx, skew, cx, _, fy, cy = K
    y = np.broadcast_to((np.arange(height) + 0.5 - cy)[:, None] / fy, (height, width))
    x = ((np.arange(width) + 0.5 - cx)[None, :] - skew * y) / fx
    straight_x, straight_y = x, y
    with np.errstate(all="ignore"):
        for _ in range(_SOLVER_STEPS):
            lens_x, lens_y = distort(lens, straight_x, straight_y)
            straight_x, straight_y = straight_x + x - lens_x, straight_y + y - lens_y
        positions = fx * straight_x + cx - 0.5, fy * straight_y + cy - 0.5
    columns, rows = (np.nan_to_num(place, nan=-8, posinf=-8, neginf=-8).astype(np.float32) for place in positions)
    return columns, rows


# Each step multiplies the error by 1 - s, where s is the slope of the distortion: 1/4 at 60 degrees from a fisheye's
# axis.
_SOLVER_STEPS = 40

# At an offset o from a pixel, cv2's cubic kernel (a = -0.75) interpolates a ramp as 1.5 o - 1.5 o^2 + o^3, up to 0.05
# pixels off. This is the inverse function, for offsets in steps of 1 / 4096.
_CUBIC_OFFSETS = (0.5 + np.sinh(np.arcsinh(4 * np.linspace(0, 1, 4097) - 2) / 3)).astype(np.float32)


def _for_cubic(positions: Float32[np.ndarray, "H W"], length: int) -> Float32[np.ndarray, "H W"]:
    """Positions at which cv2's cubic interpolation returns the values at `positions`; far ones move near the border."""
    positions = np.clip(np.nan_to_num(positions, nan=-8), -8, length + 8)
    whole = np.floor(positions)
    return whole + _CUBIC_OFFSETS[np.rint(4096 * (positions - whole)).astype(np.int32)]
