"""Pictures as arrays: sRGB values in [0, 1], `[H W 3]`, read by OpenImageIO."""

from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio  # noqa: N813
from jaxtyping import Float, Float32

from l2dgs_jax.errors import UserError

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")


def read_image(path: Path) -> Float32[np.ndarray, "H W 3"]:
    """Read a picture of 8 or 16 bits, grey or colour; alpha is dropped, not multiplied in.

    Raises:
        UserError: the file is missing or cannot be read whole.
    """
    with closing(_open(path)) as file:
        pixels = file.read_image(oiio.FLOAT)
        if pixels is None:
            raise UserError(f"{path}: expected a readable picture, but it is damaged ({_reason(file.geterror())})")
    channels = [0, 1, 2] if pixels.shape[-1] >= 3 else [0, 0, 0]
    return np.asarray(pixels[..., channels], np.float32)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture, from its header.

    Raises:
        UserError: the file is missing or no picture.
    """
    with closing(_open(path)) as file:
        return file.spec().width, file.spec().height


def area_average(image: Float32[np.ndarray, "H W 3"], factor: int) -> Float32[np.ndarray, "h w 3"]:
    """Shrink by a whole factor, each pixel the mean of a block.

    Rows and columns that fill no block are cropped from the bottom and the right, so that dividing K by `factor`
    stays exact.
    """
    height, width = image.shape[0] // factor, image.shape[1] // factor
    blocks = image[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    return blocks.mean((1, 3))


def undistort(
    image: Float32[np.ndarray, "H W 3"], K: Float[np.ndarray, "3 3"], distortion: Float[np.ndarray, "5"]
) -> Float32[np.ndarray, "H W 3"]:
    """The picture that the pinhole camera `without_skew(K)` would have taken.

    Pixels that the lens did not see repeat the nearest one that it did.

    Args:
        image: as taken through the lens.
        K: intrinsics of `image`, skew included.
        distortion: (k1, k2, p1, p2, k3) of the Brown-Conrady model in OpenCV's order.
    """
    if not distortion.any() and K[0, 1] == 0:
        return image
    height, width = image.shape[:2]
    x = (np.arange(width) + 0.5 - K[0, 2])[None, :] / K[0, 0]
    y = (np.arange(height) + 0.5 - K[1, 2])[:, None] / K[1, 1]
    k1, k2, p1, p2, k3 = distortion
    r2 = x**2 + y**2
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    lens_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    lens_y = y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y**2)
    # cv2.remap counts pixel centres from 0.
    columns = (K[0, 0] * lens_x + K[0, 1] * lens_y + K[0, 2] - 0.5).astype(np.float32)
    rows = (K[1, 1] * lens_y + K[1, 2] - 0.5).astype(np.float32)
    warped = cv2.remap(image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(warped, 0, 1)  # cubic interpolation overshoots


def scale_intrinsics(K: Float[np.ndarray, "3 3"], factor: int) -> Float[np.ndarray, "3 3"]:
    """Intrinsics of a picture shrunk by `factor`; exact because pixel centres lie at +0.5."""
    return K / np.array([[factor], [factor], [1]])


def without_skew(K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Intrinsics of the pictures that `undistort` returns."""
    return np.where(np.arange(9).reshape(3, 3) == 1, 0.0, K)


def _open(path: Path) -> oiio.ImageInput:
    if not path.is_file():
        raise UserError(f"{path}: no such file; expected a picture")
    # Without this hint OpenImageIO multiplies colours by alpha, and pixels of alpha 0 turn black.
    keep = oiio.ImageSpec()
    keep.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), keep)
    if file is None:
        raise UserError(f"{path}: expected a readable picture ({_reason(oiio.geterror())})")
    return file


def _reason(message: str) -> str:
    """OpenImageIO's message on one line."""
    return " ".join(message.split()) or "no reason given"
