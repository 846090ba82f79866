"""What the kernels of the rasterizer share: tiles, lists, and thresholds."""

from typing import NamedTuple

from jaxtyping import Array, Int

TILE_SIZE = 8  # pixels along each side
MIN_ALPHA = 1 / 255  # contributions below are skipped
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4  # the Gaussian that would lower it to this or less ends the pixel and is itself left out


class Tiling(NamedTuple):
    """Sizes of a list of (Gaussian, tile) pairs: views, columns and rows of tiles in each, and pairs it can hold."""

    views: int
    columns: int
    rows: int
    capacity: int


class TileLists(NamedTuple):
    """For each tile of all views, the Gaussians that may touch it, nearest first.

    Attributes:
        gaussians: flat indices (view * N + n), the lists one after the other.
        starts: index of the first entry of each tile's list.
        stops: index after its last entry.
    """

    gaussians: Int[Array, "*B M"]
    starts: Int[Array, "*B T"]
    stops: Int[Array, "*B T"]


def grid(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of tiles that cover an image."""
    return -(-width // TILE_SIZE), -(-height // TILE_SIZE)
