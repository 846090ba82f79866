"""Pictures as arrays: sRGB values in [0, 1], `[H W 3]`, read and written by OpenImageIO."""

import os
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import OpenImageIO as oiio  # noqa: N813
from jaxtyping import Bool, Float, Float32, Shaped, UInt8

from l2dgs_jax.data.color import linear_to_srgb
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.files import replacing, reserve

FILE_OVERHEAD = 2**16  # bytes of a picture's file beside its pixels, at most
SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr", ".hdr", ".bmp")


class Header(NamedTuple):
    """What the header of a picture file says.

    Attributes:
        size: width and height in pixels, upright.
        orientation: EXIF's number, from 1 (stored upright) to 8; from 5 on, width and height are stored swapped.
        linear: whether it holds linear light instead of sRGB values.
    """

    size: tuple[int, int]
    orientation: int
    linear: bool


def read_image(path: Path, upright: bool = True) -> Float32[np.ndarray, "H W 3"]:
    """Read a grey or colour picture; alpha is dropped, and premultiplied colours are divided by it.

    Integers of any bit depth are sRGB values, as cameras write them. Floating-point values (EXR, Radiance HDR, TIFF)
    are linear light unless the file says otherwise: they are clipped to [0, 1] and converted.

    Args:
        path: the file.
        upright: whether to turn the picture as its EXIF orientation says.

    Raises:
        UserError: the file is missing, cannot be read whole, or holds values that are not finite.
    """
    return read_image_and_alpha(path, upright)[0]


def read_image_and_alpha(
    path: Path, upright: bool = True
) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W 1"] | None]:
    """Like `read_image`, with the alpha channel if there is one."""
    color, alpha, associated, linear = _read(path, upright)
    if alpha is not None and associated:
        color = np.divide(color, alpha, out=color.copy(), where=alpha > 0)
    return _as_srgb(color, linear), alpha


def read_over_black(path: Path, upright: bool = True) -> Float32[np.ndarray, "H W 3"]:
    """Like `read_image`, but composited over black, before any conversion from linear light to sRGB."""
    color, alpha, associated, linear = _read(path, upright)
    return _as_srgb(color if alpha is None or associated else color * alpha, linear)


def _read(
    path: Path, upright: bool
) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W 1"] | None, bool, bool]:
    """Colour as stored, alpha if any, whether colour is premultiplied by alpha, and whether it is linear light."""
    with closing(_open(path)) as file:
        spec = file.spec()
        pixels = file.read_image(oiio.FLOAT)
        if pixels is None:
            raise UserError(f"{path}: expected a readable picture, but it is damaged ({_reason(file.geterror())})")
        kind = file.format_name()
    if kind == "jpeg" and not _is_whole_jpeg(path.read_bytes()):  # what is missing would be grey
        raise UserError(f"{path}: expected a readable picture, but its end is missing")
    pixels = _upright(np.asarray(pixels, np.float32), _orientation(spec) if upright else 1)
    if _is_float(spec) and not np.isfinite(pixels).all():
        raise UserError(f"{path}: holds NaN or infinite values; expected finite colours")
    color = pixels[..., :3] if pixels.shape[-1] >= 3 else np.repeat(pixels[..., :1], 3, axis=-1)
    channel = spec.alpha_channel
    return (
        np.ascontiguousarray(color),
        None if channel < 0 else np.ascontiguousarray(pixels[..., channel : channel + 1]),
        kind in ("openexr", "tiff") and not spec.getattribute("oiio:UnassociatedAlpha"),
        _is_linear(spec),
    )


def _as_srgb(color: Float32[np.ndarray, "H W 3"], linear: bool) -> Float32[np.ndarray, "H W 3"]:
    """Stored colour as sRGB values in [0, 1]."""
    clipped = np.clip(color, 0, 1)
    return linear_to_srgb(clipped) if linear else clipped


def read_header(path: Path) -> Header:
    """What a picture's header says.

    Raises:
        UserError: the file is missing or not a picture.
    """
    with closing(_open(path)) as file:
        spec = file.spec()
        orientation = _orientation(spec)
        size = (spec.height, spec.width) if orientation >= 5 else (spec.width, spec.height)
        return Header(size, orientation, _is_linear(spec))


def write_image(path: Path, image: Shaped[np.ndarray, "H W *C"]) -> None:
    """Write an image of integers, or of floats to EXR, whole or not at all; the suffix of `path` gives the format.

    Raises:
        UserError: the file cannot be written.
    """
    pixels = oiio.ImageBuf(np.ascontiguousarray(image))
    pixels.specmod().attribute("oiio:UnassociatedAlpha", 1)
    with replacing(path) as temporary:
        with open(temporary, "wb") as file:  # OpenImageIO, which writes it anew, says nothing if the disk is full
            reserve(file.fileno(), image.nbytes * 17 // 16 + FILE_OVERHEAD)
        if not pixels.write(str(temporary)):
            reason = _reason(f"{pixels.geterror()} {oiio.geterror()}")
            raise UserError(f"{path}: cannot be written ({reason}); expected a picture's suffix and a writable folder")


def to_bytes(image: Float[np.ndarray, "*shape"] | Bool[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Values in [0, 1], clipped, as rounded 8-bit integers."""
    return np.round(np.clip(np.asarray(image, np.float32), 0, 1) * 255).astype(np.uint8)


def encode_jpeg(picture: UInt8[np.ndarray, "H W 3"], quality: int) -> bytes:
    """Content of a JPEG file; `quality` is at most 100."""
    _, content = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return content.tobytes()


def area_average(image: Float32[np.ndarray, "H W C"], factor: int) -> Float32[np.ndarray, "h w C"]:
    """Shrink by an integer factor; each pixel is the mean of a block.

    Rows and columns at the bottom and the right that do not fill a block are cropped, so that dividing K by `factor`
    is exact.
    """
    height, width, channels = image.shape[0] // factor, image.shape[1] // factor, image.shape[2]
    whole = image[: height * factor, : width * factor]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).reshape(height, width, channels)


def _open(path: Path) -> oiio.ImageInput:
    if not os.path.isfile(path):
        raise UserError(f"{path}: no such file; expected a picture")
    # Without this hint OpenImageIO multiplies colours by alpha, which turns pixels of alpha 0 black. Colours that are
    # premultiplied in the file (EXR, some TIFF) remain so.
    keep = oiio.ImageSpec()
    keep.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), keep)
    if file is None:
        raise UserError(f"{path}: expected a readable picture ({_reason(oiio.geterror())})")
    return file


def _is_whole_jpeg(content: bytes) -> bool:
    """Whether the end of a JPEG picture follows its first scan; a thumbnail in its header has an end of its own."""
    at, scan, end = 2, 0xDA, b"\xff\xd9"
    while content[at : at + 1] == b"\xff" and at + 4 <= len(content) and content[at + 1] != scan:
        fill = content[at + 1] == 0xFF  # of which any number may precede a marker
        at += 1 if fill else 2 + int.from_bytes(content[at + 2 : at + 4], "big")
    return end in content[at:]


def _orientation(spec: oiio.ImageSpec) -> int:
    """EXIF's orientation number, from 1 (upright) to 8."""
    value = spec.getattribute("Orientation")
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def _upright(pixels: Float32[np.ndarray, "h w C"], orientation: int) -> Float32[np.ndarray, "H W C"]:
    """The picture turned upright, given EXIF's orientation of its stored rows and columns."""
    if orientation >= 5:
        pixels = pixels.transpose(1, 0, 2)
    flip_rows = orientation in (3, 4, 7, 8)
    flip_columns = orientation in (2, 3, 6, 7)
    return pixels[:: -1 if flip_rows else 1, :: -1 if flip_columns else 1]


def _is_float(spec: oiio.ImageSpec) -> bool:
    return spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)


def _is_linear(spec: oiio.ImageSpec) -> bool:
    return _is_float(spec) and "srgb" not in str(spec.getattribute("oiio:ColorSpace") or "").lower()


def _reason(message: str) -> str:
    """OpenImageIO's message on one line."""
    return " ".join(message.split()) or "no reason given"
