"""The sizes of pictures: few, because each one is a program to compile."""

import math
from collections.abc import Mapping, Sequence

Size = tuple[int, int]  # width and height, pixels

PIXEL_COUNTS = (320 * 180, 640 * 360, 1280 * 720, 1920 * 1080)
ASPECTS = (1 / 2, 3 / 4, 1.0, 4 / 3, 16 / 9, 12 / 5)  # width over height
SECONDS_MOVING = 0.1  # that rendering a picture may take while the camera or time moves
SECONDS_STILL = 1.5  # that it may take while nothing moves


def ladder(window: Size) -> tuple[Size, ...]:
    """Sizes of pictures for a window, smallest first, up to the first with at least as many pixels as the window.

    A picture fills the window, whose aspect ratio is rarely one of `ASPECTS`, so its pixels need not be square.
    """
    width, height = window
    aspect = min(ASPECTS, key=lambda known: abs(math.log(known * height / width)))
    smaller = sum(pixels < width * height for pixels in PIXEL_COUNTS)
    return tuple((_side(pixels * aspect), _side(pixels / aspect)) for pixels in PIXEL_COUNTS[: smaller + 1])


def _side(square: float) -> int:
    return 4 * round(math.sqrt(square) / 4)


def while_moving(sizes: Sequence[Size], seconds: Mapping[Size, float]) -> Size:
    """The largest size that takes no longer than `SECONDS_MOVING`, or else the smallest."""
    fast = (size for size in sizes if seconds[size] <= SECONDS_MOVING)
    return max(fast, key=math.prod, default=min(sizes, key=math.prod))


def sharper(sizes: Sequence[Size], size: Size) -> Size | None:
    """The next larger size, if there is one."""
    return min((other for other in sizes if math.prod(other) > math.prod(size)), key=math.prod, default=None)
