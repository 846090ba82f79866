"""Pairs of Gaussians and tiles: every form finds the pairs that dense sampling finds."""

import jax
import jax.numpy as jnp
import numpy as np

from l2dgs_jax.kernels import use_kernels
from l2dgs_jax.kernels.tile_lists import list_pairs
from l2dgs_jax.kernels.tiles import TILE_SIZE, Tiling

VIEWS, COLUMNS, ROWS, COUNT = 2, 5, 4, 12
NO_TILE = VIEWS * COLUMNS * ROWS


def gaussians(count=COUNT, seed=0):
    """Boxes that are larger than the ellipses, some of them empty."""
    random = np.random.default_rng(seed)
    size = VIEWS * count
    mean = random.uniform(0, [TILE_SIZE * COLUMNS, TILE_SIZE * ROWS], (size, 2))
    spread = random.uniform(1, 8, (size, 2))
    slant = random.uniform(-0.9, 0.9, size)
    conic = np.stack([1 / spread[:, 0] ** 2, slant / spread.prod(1), 1 / spread[:, 1] ** 2], axis=1)
    first = np.clip(np.floor((mean - 12) / TILE_SIZE), 0, [COLUMNS - 1, ROWS - 1]).astype(np.int32)
    counts = np.minimum(random.integers(0, 5, (size, 2)), [COLUMNS, ROWS] - first).astype(np.int32)
    box = np.concatenate([first, counts], axis=1)
    ellipse = np.concatenate([mean, conic, random.uniform(0.5, 4, (size, 1))], axis=1)
    return jnp.asarray(box, jnp.int32), jnp.asarray(ellipse)


def pairs_and_tiles(box, ellipse, capacity=VIEWS * COUNT * COLUMNS * ROWS):
    tile, row = list_pairs(box, ellipse, Tiling(VIEWS, COLUMNS, ROWS, capacity))
    assert tile.dtype == row.dtype == jnp.int32
    assert tile.shape == row.shape == (capacity,)
    tile, row = np.asarray(tile), np.asarray(row)
    return [(int(t), int(r)) for t, r in zip(tile, row, strict=True) if t < NO_TILE], tile


def test_pairs_are_the_ellipses_and_tiles_that_touch(any_way):
    box, ellipse = gaussians()
    pairs, _ = pairs_and_tiles(box, ellipse)
    expected = set()
    for row, ((left, top, width, height), (x, y, a, b, c, reach)) in enumerate(
        zip(*map(np.asarray, (box, ellipse)), strict=True)
    ):
        for column in range(left, left + width):
            for line in range(top, top + height):
                # The continuous rectangle between pixel centres, finely sampled.
                u, v = np.meshgrid(
                    *(TILE_SIZE * k + 0.5 + np.linspace(0, TILE_SIZE - 1, 141) - m for k, m in ((column, x), (line, y)))
                )
                q = a * u * u + 2 * b * u * v + c * v * v
                if q.min() <= reach:
                    expected.add((row // COUNT * COLUMNS * ROWS + line * COLUMNS + column, row))
    assert len(pairs) == len(set(pairs)) > 40
    # Sampling misses the minimum by a little: a few more pairs may be found than by sampling, never fewer.
    assert expected <= set(pairs)
    assert len(pairs) <= len(expected) + 2
    for tile in {t for t, _ in pairs}:
        rows = [r for t, r in pairs if t == tile]
        assert rows == sorted(rows)


def test_pairs_beyond_the_capacity_are_dropped(any_form):
    box, ellipse = gaussians()
    kept, _ = pairs_and_tiles(box, ellipse, 40)
    with use_kernels("reference"):
        all_pairs, _ = pairs_and_tiles(box, ellipse)
    assert len(kept) <= 40
    assert set(kept) < set(all_pairs)


def test_no_gaussians_and_empty_boxes_give_no_pairs(any_form):
    box, ellipse = gaussians()
    assert (pairs_and_tiles(box[:0], ellipse[:0])[1] == NO_TILE).all()
    assert (pairs_and_tiles(box.at[:, 2:].set(0), ellipse)[1] == NO_TILE).all()


def test_one_gaussian_is_paired_with_the_tiles_of_its_box(any_form):
    box, ellipse = jnp.array([[1, 1, 2, 2]], jnp.int32), jnp.array([[16.0, 16.0, 0.1, 0.0, 0.1, 3.0]])
    tile, row = list_pairs(box, ellipse, Tiling(1, COLUMNS, ROWS, 8))
    assert sorted(np.asarray(tile).tolist())[:4] == [COLUMNS + 1, COLUMNS + 2, 2 * COLUMNS + 1, 2 * COLUMNS + 2]
    assert (np.asarray(row) == 0).all()


def test_a_nan_touches_every_tile_of_its_box(any_form):
    box, ellipse = gaussians()
    box = box.at[3].set(jnp.array([1, 1, 2, 2], jnp.int32))
    pairs, _ = pairs_and_tiles(box, ellipse.at[3].set(jnp.nan))
    assert sum(row == 3 for _, row in pairs) == 4


def test_vmap_equals_a_loop(any_form):
    scenes = [gaussians(seed=seed) for seed in range(3)]
    box, ellipse = (jnp.stack(x) for x in zip(*scenes, strict=True))
    tiling = Tiling(VIEWS, COLUMNS, ROWS, 512)
    together = jax.jit(jax.vmap(lambda b, e: list_pairs(b, e, tiling)))(box, ellipse)
    for index, scene in enumerate(scenes):
        for actual, wanted in zip(together, list_pairs(*scene, tiling), strict=True):
            np.testing.assert_array_equal(actual[index], wanted)
