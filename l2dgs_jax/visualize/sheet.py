"""Sheets: pictures in rows and columns under headings."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from l2dgs_jax.data.images import to_bytes

CELL_WIDTHS = (160, 400)  # least and largest width of a picture on the sheet, pixels


STRIP_HEIGHT = 22  # of a line of text, pixels
GAP = 4  # pixels between pictures


def sheet(
    headings: Sequence[str], rows: Sequence[tuple[str, Sequence[UInt8[np.ndarray, "h w 3"]]]]
) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures of the same size in rows under common headings; each row has its caption above it."""
    lines = []
    for caption, pictures in rows:
        cells = np.hstack([np.pad(cell(picture), ((0, GAP), (0, GAP), (0, 0))) for picture in pictures])
        lines += [text_strip(caption, cells.shape[1]), cells]
    header = np.hstack([text_strip(heading, lines[1].shape[1] // len(headings)) for heading in headings])
    return np.vstack([header, *lines])


def viridis(values: Float[np.ndarray, "H W"], low: float, high: float) -> UInt8[np.ndarray, "H W 3"]:
    """The colour map viridis, from dark violet at `low` to yellow at `high`; its lightness increases throughout."""
    scaled = (values - low) / (high - low) if high > low else np.zeros_like(values)
    return np.ascontiguousarray(cv2.applyColorMap(to_bytes(scaled), cv2.COLORMAP_VIRIDIS)[..., ::-1])


def cell(picture: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture at a width within `CELL_WIDTHS`: enlarged by an integer factor, or reduced."""
    narrow, wide = CELL_WIDTHS
    height, width = picture.shape[:2]
    if width > wide:
        return cv2.resize(picture, (wide, round(height * wide / width)), interpolation=cv2.INTER_AREA)
    factor = -(-narrow // width)
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


def text_strip(text: str, width: int) -> UInt8[np.ndarray, "h w 3"]:
    """One line of text, white on black; what does not fit is cut off."""
    strip = np.zeros((STRIP_HEIGHT, width, 3), np.uint8)
    place = (4, STRIP_HEIGHT - 7)
    return cv2.putText(strip, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
