"""The ladder of picture sizes."""

import math

from hypothesis import given
from hypothesis import strategies as st

from l2dgs_jax.viewer.ladder import ASPECTS, PIXEL_COUNTS, SECONDS_MOVING, ladder, sharper, while_moving

WINDOWS = st.tuples(st.integers(1, 5000), st.integers(1, 5000))


@given(WINDOWS)
def test_sizes_grow_until_they_fill_the_window(window):
    sizes = ladder(window)
    pixels = [width * height for width, height in sizes]
    assert pixels == sorted(set(pixels))
    assert all(side % 4 == 0 for size in sizes for side in size)
    assert len(sizes) == len(PIXEL_COUNTS) or pixels[-1] > 0.9 * math.prod(window)
    assert len(sizes) == 1 or PIXEL_COUNTS[len(sizes) - 2] < math.prod(window)


def test_there_are_few_sizes():
    windows = [(width, height) for width in range(50, 4000, 50) for height in range(50, 2200, 50)]
    assert len({size for window in windows for size in ladder(window)}) <= len(ASPECTS) * len(PIXEL_COUNTS)


@given(st.floats(0.5, 2.4))
def test_pixels_are_nearly_square(aspect):
    width, height = ladder((round(900 * aspect), 900))[1]
    assert abs(math.log(aspect * height / width)) < math.log(1.26)


@given(WINDOWS, st.lists(st.floats(0.001, 2), min_size=4, max_size=4))
def test_while_moving_the_largest_size_that_is_fast_enough_is_drawn(window, times):
    sizes = ladder(window)
    seconds = dict(zip(sizes, times, strict=False))
    size = while_moving(sizes, seconds)
    assert seconds[size] <= SECONDS_MOVING or size == sizes[0]
    assert all(seconds[other] > SECONDS_MOVING for other in sizes[sizes.index(size) + 1 :])


@given(WINDOWS)
def test_sharpening_climbs_to_the_largest_size(window):
    sizes = ladder(window)
    seen = [sizes[0]]
    while size := sharper(sizes, seen[-1]):
        seen.append(size)
    assert tuple(seen) == sizes
