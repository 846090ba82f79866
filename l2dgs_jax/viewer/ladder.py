"""The sizes that pictures come in: few, because every one is a program to compile."""

import math
from collections.abc import Mapping, Sequence

Size = tuple[int, int]  # width and height, pixels

STEPS = (320 * 180, 640 * 360, 1280 * 720, 1920 * 1080)  # pixels
ASPECTS = (1 / 2, 3 / 4, 1.0, 4 / 3, 16 / 9, 12 / 5)  # width over height
MOVING = 0.1  # seconds that a picture may take while something moves
STILL = 1.5  # and when nothing does


def ladder(window: Size) -> tuple[Size, ...]:
    """Sizes of pictures for a window, smallest first, up to the first that has as many pixels.

    A picture fills the window, whose aspect is rarely one of `ASPECTS`: pixels need not be square.
    """
    width, height = window
    aspect = min(ASPECTS, key=lambda known: abs(math.log(known * height / width)))
    smaller = sum(pixels < width * height for pixels in STEPS)
    return tuple((_side(pixels * aspect), _side(pixels / aspect)) for pixels in STEPS[: smaller + 1])


def _side(square: float) -> int:
    return 4 * round(math.sqrt(square) / 4)


def while_moving(sizes: Sequence[Size], seconds: Mapping[Size, float]) -> Size:
    """The largest size that takes no longer than `MOVING`, or else the smallest."""
    return max((size for size in sizes if seconds[size] <= MOVING), key=math.prod, default=min(sizes, key=math.prod))


def sharper(sizes: Sequence[Size], size: Size) -> Size | None:
    """The next larger size, if there is one."""
    return min((other for other in sizes if math.prod(other) > math.prod(size)), key=math.prod, default=None)
