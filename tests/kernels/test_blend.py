"""Blending of lists of any length: every form, in full and partial blocks, and the gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.kernels import use_kernels
from l2dgs_jax.kernels.blend import blend, cpu
from l2dgs_jax.kernels.tiles import TILE_SIZE, TileLists

WIDTH, HEIGHT = 5 * TILE_SIZE - 3, 2 * TILE_SIZE
TILES, COUNT, CHANNELS = 10, 30, 3
LENGTHS = [7, 0, 25, 1, 0, 13, 4, 0, 9, 2]  # of the lists; some are longer than a chunk


def case(seed=0):
    random = np.random.default_rng(seed)
    mean = random.uniform(0, [WIDTH, HEIGHT], (COUNT, 2))
    conic = np.tile([0.02, 0.004, 0.03], (COUNT, 1)) * random.uniform(0.5, 2, (COUNT, 1))
    opacity = random.uniform(0.1, 1, (COUNT, 1))
    packed = np.concatenate([mean, conic, opacity, random.normal(size=(COUNT, CHANNELS))], axis=1)
    chosen = np.concatenate([random.permutation(COUNT)[:length] for length in LENGTHS])
    spare = random.integers(0, COUNT, 6)  # beyond the last list, as in a buffer that is not full
    stops = np.cumsum(LENGTHS)
    starts = stops - LENGTHS
    lists = TileLists(*(jnp.asarray(x, jnp.int32) for x in (np.concatenate([chosen, spare]), starts, stops)))
    return jnp.asarray(packed), lists


def with_gradient(packed, lists, cotangent):
    value, pull = jax.vjp(lambda packed: blend(packed, lists, WIDTH, HEIGHT), packed)
    return value, pull(cotangent)[0]


compiled = jax.jit(with_gradient)


def blend_pixel_by_pixel(packed, lists):
    """The definition, for one pixel after the other."""
    packed, columns = np.asarray(packed), -(-WIDTH // TILE_SIZE)
    image = np.zeros((TILES, CHANNELS, TILE_SIZE * TILE_SIZE))
    for tile, (start, stop) in enumerate(zip(lists.starts, lists.stops, strict=True)):
        for pixel in range(TILE_SIZE * TILE_SIZE):
            x = TILE_SIZE * (tile % columns) + pixel % TILE_SIZE + 0.5
            y = TILE_SIZE * (tile // columns) + pixel // TILE_SIZE + 0.5
            transmittance = 1.0
            for mx, my, a, b, c, opacity, *features in packed[np.asarray(lists.gaussians[start:stop])]:
                dx, dy = x - mx, y - my
                alpha = min(0.999, opacity * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy)))
                if alpha < 1 / 255:
                    continue
                if transmittance * (1 - alpha) <= 1e-4:
                    break
                image[tile, :, pixel] += transmittance * alpha * np.array(features)
                transmittance *= 1 - alpha
    return image


def test_the_reference_matches_the_definition():
    packed, lists = case()
    with use_kernels("reference"):
        np.testing.assert_allclose(blend(packed, lists, WIDTH, HEIGHT), blend_pixel_by_pixel(packed, lists), atol=1e-12)
        few = lists._replace(stops=jnp.minimum(lists.stops, lists.starts + 2))
        check_grads(jax.jit(lambda p: blend(p, few, WIDTH, HEIGHT)), (0.4 * packed,), 1, ["rev"], eps=1e-6)


def assert_matches_the_reference():
    packed, lists = case()
    cotangent = jnp.asarray(np.random.default_rng(1).normal(size=(TILES, CHANNELS, TILE_SIZE * TILE_SIZE)))
    actual = compiled(packed, lists, cotangent)
    with use_kernels("reference"):
        expected = compiled(packed, lists, cotangent)
    for a, e in zip(actual, expected, strict=True):
        np.testing.assert_allclose(a, e, rtol=1e-10, atol=1e-12)


def test_every_form_matches_the_reference(any_way):
    assert_matches_the_reference()


@pytest.mark.parametrize("block", [3, 5])
def test_full_and_partial_blocks_match_the_reference(monkeypatch, block):
    monkeypatch.setattr(cpu, "BLOCK_SIZE", block)
    packed, lists = case(seed=block)
    cotangent = jnp.ones((TILES, CHANNELS, TILE_SIZE * TILE_SIZE))
    with use_kernels("cpu"):
        actual = jax.jit(lambda *arrays: with_gradient(*arrays))(packed, lists, cotangent)  # recompiled
    with use_kernels("reference"):
        expected = compiled(packed, lists, cotangent)
    for a, e in zip(actual, expected, strict=True):
        np.testing.assert_allclose(a, e, rtol=1e-10, atol=1e-12)


def test_a_single_gaussian_is_blended(any_form):
    packed, lists = case()
    alone = lists._replace(gaussians=0 * lists.gaussians, stops=jnp.minimum(lists.stops, lists.starts + 1))
    value, gradient = compiled(packed[:1], alone, jnp.ones((TILES, CHANNELS, TILE_SIZE * TILE_SIZE)))
    np.testing.assert_allclose(value, blend_pixel_by_pixel(packed[:1], alone), atol=1e-12)
    assert np.isfinite(gradient).all()


def test_vmap_equals_a_loop(any_form):
    cases = [case(seed) for seed in range(2)]
    packed, lists = (jax.tree.map(lambda *x: jnp.stack(x), *x) for x in zip(*cases, strict=True))
    cotangent = jnp.ones((TILES, CHANNELS, TILE_SIZE * TILE_SIZE))
    together = jax.jit(jax.vmap(with_gradient, (0, 0, None)))(packed, lists, cotangent)
    with use_kernels("reference"):
        alone = [compiled(*arrays, cotangent) for arrays in cases]
    for actual, wanted in zip(together, map(jnp.stack, zip(*alone, strict=True)), strict=True):
        np.testing.assert_allclose(actual, wanted, rtol=1e-10, atol=1e-12)


def test_no_gaussians_give_zeros(any_form):
    packed, lists = case()
    nothing = TileLists(lists.gaussians[:1], 0 * lists.starts, 0 * lists.stops)
    value, gradient = with_gradient(packed[:0], nothing, jnp.ones((TILES, CHANNELS, TILE_SIZE * TILE_SIZE)))
    assert not value.any()
    assert gradient.shape == (0, packed.shape[1])
    # Empty lists of Gaussians that exist.
    value, gradient = compiled(packed, nothing, jnp.ones((TILES, CHANNELS, TILE_SIZE * TILE_SIZE)))
    assert not value.any()
    assert not gradient.any()


def test_nan_is_not_hidden(any_form):
    packed, lists = case()
    row = int(lists.gaussians[0])
    assert np.isnan(jax.jit(lambda p: blend(p, lists, WIDTH, HEIGHT))(packed.at[row, 0].set(jnp.nan))[0]).any()
