"""Initial scenes, and growing their arrays."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloud import POINTS, cameras

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.model import initialisation
from l2dgs_jax.model.initialisation import SH_DC
from l2dgs_jax.runtime.capacity import next_capacity
from l2dgs_jax.training.parameter_groups import groups

CFG = ModelConfig(plane_size=4, plane_scales=(1,), plane_channels=2, hidden=4, sh_degree=1)


CAMERAS = cameras([[-1, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0]])


def initialise(cfg=CFG, colors=None, points=POINTS, **arguments):
    return initialisation.initialise(jax.random.key(0), points, colors, CAMERAS, cfg, capacity=32, **arguments)


def test_each_point_becomes_a_gaussian_and_dead_rows_follow():
    start = initialise()
    gaussians = start.params.gaussians
    np.testing.assert_array_equal(start.alive, np.arange(32) < 20)
    np.testing.assert_allclose(gaussians.means[:20], POINTS)
    np.testing.assert_allclose(jax.nn.sigmoid(gaussians.logit_opacities[:20]), 0.1)
    np.testing.assert_array_equal(gaussians.quats[:20], np.tile([1, 0, 0, 0], (20, 1)))
    for rows in jax.tree.leaves(gaussians):
        np.testing.assert_array_equal(rows[20:], 0)
    np.testing.assert_allclose(start.bounds, [POINTS.min(0), POINTS.max(0)])
    np.testing.assert_allclose(start.extent, 1.1)
    assert start.params.hexplane.time[0].shape[1] == len(CAMERAS.time) // 2


def test_scales_are_the_rms_distance_to_the_three_nearest_points():
    distances = np.linalg.norm(POINTS[:, None] - POINTS[None], axis=-1)
    nearest = np.sort(distances, axis=1)[:, 1:4]
    expected = np.sqrt(np.mean(nearest**2, axis=1))
    np.testing.assert_allclose(np.exp(initialise().params.gaussians.log_scales[:20, 0]), expected, rtol=1e-5)


def test_illumination_is_the_luminance_of_the_points():
    colors = np.random.default_rng(1).uniform(size=(20, 3))
    dc = initialise(colors=colors).params.gaussians.illumination_dc[:20, 0]
    np.testing.assert_allclose(CFG.illumination_offset + SH_DC * dc, colors @ [0.2989, 0.587, 0.114], rtol=1e-6)
    set_dc = initialise(dataclasses.replace(CFG, initial_illumination=0.8)).params.gaussians.illumination_dc[:20]
    np.testing.assert_allclose(CFG.illumination_offset + SH_DC * set_dc, 0.8, rtol=1e-6)


def test_lamps_start_with_more_light_but_not_beyond_the_bound():
    light = np.linspace(1, 2, 20)
    dc = initialise(dataclasses.replace(CFG, initial_illumination=0.8), light=light).params.gaussians.illumination_dc
    start = CFG.illumination_offset + SH_DC * dc[:20, 0]
    np.testing.assert_allclose(start, np.minimum(0.8 * light, initialisation.MAX_ILLUMINATION), rtol=1e-6)


@pytest.mark.parametrize("kind", ["uniform", "normal"])
def test_random_reflectances_have_the_chosen_distribution(kind):
    points = np.random.default_rng(2).normal(size=(3000, 3))
    cfg = dataclasses.replace(CFG, reflectance_init=kind)
    start = initialisation.initialise(jax.random.key(0), points, None, CAMERAS, cfg, capacity=3000)
    values = np.asarray(start.params.gaussians.reflectance)
    mean, deviation = {"uniform": (0.5, 12**-0.5), "normal": (0, 1)}[kind]
    assert abs(values.mean() - mean) < 0.05
    assert abs(values.std() - deviation) < 0.05
    outside = np.mean((values < 0) | (values > 1))
    expected, tolerance = {"uniform": (0, 0), "normal": (0.659, 0.02)}[kind]
    assert abs(outside - expected) <= tolerance


def test_a_single_point_is_enough():
    start = initialise(points=POINTS[:1])
    assert np.isfinite(np.concatenate([np.ravel(x) for x in jax.tree.leaves(start.params)])).all()


def test_every_parameter_has_a_group():
    params = initialise().params
    labels = jax.tree.leaves(groups(params))
    assert len(labels) == len(jax.tree.leaves(params))
    assert {"means", "reflectance", "planes", "heads", "ocd", "bafe"} <= set(labels)
    assert groups(params).gaussians.log_scales == "scales"


def test_capacities_grow_by_about_half_at_each_step():
    sizes = sorted({next_capacity(count) for count in range(1, 50_000, 7)})
    assert all(next_capacity(count) >= count for count in (1, 1024, 1025, 40_000))
    assert all(1.3 < b / a < 1.7 for a, b in itertools.pairwise(sizes))


def test_padding_appends_zero_rows():
    padded = initialisation.pad_rows(jnp.ones((2, 3)), 4)
    np.testing.assert_array_equal(padded, [[1] * 3, [1] * 3, [0] * 3, [0] * 3])


def test_the_z_order_keeps_neighbours_together():
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3)
    shuffled = grid[np.random.default_rng(0).permutation(len(grid))]
    ordered = shuffled[initialisation.z_order(shuffled)]
    np.testing.assert_array_equal(np.unique(ordered, axis=0), np.unique(grid, axis=0))
    # Every 8 (64) consecutive points fill a cube of 2 (4) points along each edge.
    for size in (2, 4):
        cubes = ordered.reshape(-1, size**3, 3)
        np.testing.assert_array_equal(np.ptp(cubes, axis=1), size - 1)
    np.testing.assert_array_equal(initialisation.z_order(np.ones((3, 3))), np.arange(3))


def test_the_box_spans_the_middle_quantiles_of_the_points():
    points = np.random.default_rng(2).normal([0, 0, 9], 1, (31, 3)).astype(np.float32)
    points[7] = [500, -300, 90]
    bounds = initialise(dataclasses.replace(CFG, box_points=0.9), points=points).bounds
    np.testing.assert_allclose(bounds, np.quantile(points, [0.05, 0.95], axis=0), rtol=1e-6)
    assert float(np.ptp(bounds, axis=0).max()) < 10


def test_with_unit_depth_the_extent_is_a_quarter_of_the_median_depth():
    start = initialise(dataclasses.replace(CFG, unit="depth"))
    np.testing.assert_allclose(start.extent, 0.25 * np.median(POINTS[:, 2]), rtol=1e-6)
