"""What the operations of the rasterizer agree on: tiles, lists, and thresholds."""

from typing import NamedTuple

from jaxtyping import Array, Int

TILE = 8  # pixels, each way
MIN_ALPHA = 1 / 255  # fainter contributions are skipped
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4  # a Gaussian that would leave this little light ends its pixel and is left out


class Tiling(NamedTuple):
    """Sizes of a list of pairs: views, columns and rows of tiles in each, and how many pairs it can hold."""

    views: int
    columns: int
    rows: int
    capacity: int


class TileLists(NamedTuple):
    """For each tile of all views, the Gaussians that may touch it, nearest first.

    Attributes:
        gaussians: flat indices (view * N + n), the lists one after the other.
        starts: where each tile's list starts.
        stops: where it ends.
    """

    gaussians: Int[Array, "*B M"]
    starts: Int[Array, "*B T"]
    stops: Int[Array, "*B T"]


def grid(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of tiles that cover an image."""
    return -(-width // TILE), -(-height // TILE)
