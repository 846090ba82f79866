"""HexPlane: values of a plain bilinear lookup, gradients, borders of the box, and regularisers."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.model import hexplane
from l2dgs_jax.types import HexPlane

CFG = ModelConfig(plane_size=4, plane_scales=(1, 2), plane_channels=2, time_size=5)
BOUNDS = np.array([[-1.0, 0.0, 2.0], [1.0, 3.0, 2.5]])
TIMES = np.array([0.1, 0.83])
VARIANTS = [(a, r) for a in ("paired_sum", "product") for r in ("full", "upper")]

features = jax.jit(hexplane.features, static_argnums=4)
point_gradient = jax.jit(jax.grad(lambda points, *rest: hexplane.features(rest[0], points, *rest[1:], CFG).sum()))


def variant(aggregation, time_range):
    return dataclasses.replace(CFG, aggregation=aggregation, time_range=time_range)


def random_planes(seed=0):
    rng = np.random.default_rng(seed)
    draw = lambda rows: tuple(jnp.asarray(rng.uniform(0.2, 1.5, (3, rows or size, size, 2))) for size in (4, 8))
    return HexPlane(space=draw(None), time=draw(CFG.time_size))


def random_points(count=7, seed=1):
    rng = np.random.default_rng(seed)
    return BOUNDS[0] + rng.uniform(0.02, 0.98, (count, 3)) * (BOUNDS[1] - BOUNDS[0])


def bilinear(plane, u, v):
    """Value at fractions u, v of the two axes of one plane, by the textbook formula."""
    (rows, columns, _), value = plane.shape, 0.0
    y, x = u * (rows - 1), v * (columns - 1)
    for i in range(rows):
        for j in range(columns):
            value = value + max(0.0, 1 - abs(y - i)) * max(0.0, 1 - abs(x - j)) * plane[i, j]
    return value


def oracle(planes, points, times, cfg):
    out = []
    for t in times:
        t = t if cfg.time_range == "full" else (t + 1) / 2
        for point in points:
            x, y, z = np.clip((point - BOUNDS[0]) / (BOUNDS[1] - BOUNDS[0]), 0, 1)
            for space, time in zip(planes.space, planes.time, strict=True):
                xy, yz, zx = (bilinear(p, *c) for p, c in zip(np.asarray(space), [(x, y), (y, z), (z, x)], strict=True))
                zt, xt, yt = (bilinear(p, t, c) for p, c in zip(np.asarray(time), (z, x, y), strict=True))
                pairs = xy * zt, yz * xt, zx * yt
                out.append(sum(pairs) if cfg.aggregation == "paired_sum" else np.prod(pairs, axis=0))
    return np.reshape(out, (len(times), len(points), -1))


@pytest.mark.parametrize(("aggregation", "time_range"), VARIANTS)
def test_features_match_a_plain_bilinear_lookup(aggregation, time_range):
    cfg, planes = variant(aggregation, time_range), random_planes()
    # Inside, at the corners, on cell borders, and outside the box on either side.
    outside = BOUNDS + np.array([[-5.0], [7.0]])
    points = np.concatenate([random_points(), BOUNDS, BOUNDS.mean(0)[None], outside])
    times = np.array([0.0, 0.25, 0.6, 1.0])
    actual = features(planes, jnp.asarray(points), jnp.asarray(BOUNDS), jnp.asarray(times), cfg)
    np.testing.assert_allclose(actual, oracle(planes, points, times, cfg), rtol=1e-12)


@pytest.mark.parametrize("time_range", ["full", "upper"])
def test_time_range_decides_which_cells_are_read(time_range):
    planes, cfg = random_planes(), variant("paired_sum", time_range)
    read = lambda time: features(
        planes._replace(time=time), jnp.asarray(random_points()), jnp.asarray(BOUNDS), jnp.array([0.0, 0.5, 1.0]), cfg
    ).sum()
    touched = [set(np.flatnonzero(np.abs(g).sum((0, 2, 3)))) for g in jax.jit(jax.grad(read))(planes.time)]
    assert touched == [{0, 2, 4} if time_range == "full" else {2, 3, 4}] * 2


@pytest.mark.parametrize(("aggregation", "time_range"), [("paired_sum", "full"), ("product", "upper")])
def test_gradients(aggregation, time_range):
    cfg = variant(aggregation, time_range)
    f = lambda planes, points, bounds, times: features(planes, points, bounds, times, cfg)
    planes = jax.tree.map(lambda scales: scales[1:], random_planes(), is_leaf=lambda x: type(x) is tuple)
    arguments = planes, jnp.asarray(random_points(3)), jnp.asarray(BOUNDS), jnp.asarray(TIMES)
    check_grads(f, arguments, order=1, modes=["rev"], eps=1e-5)


def test_vmap_equals_a_loop():
    points = jnp.asarray(np.stack([random_points(seed=seed) for seed in range(3)]))
    planes = jax.tree.map(lambda *x: jnp.stack(x), *(random_planes(seed) for seed in range(3)))
    gradient = jax.grad(
        lambda planes, points: jnp.square(
            hexplane.features(planes, points, jnp.asarray(BOUNDS), jnp.asarray(TIMES), CFG)
        ).sum(),
        (0, 1),
    )
    together = jax.jit(jax.vmap(gradient))(planes, points)
    member = jax.jit(gradient)
    alone = [member(jax.tree.map(lambda x, i=i: x[i], planes), points[i]) for i in range(3)]
    alone = jax.tree.map(lambda *x: jnp.stack(x), *alone)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), together, alone)


def test_a_single_point_has_features():
    planes, point = random_planes(), random_points(1)
    planes = jax.tree.map(lambda scales: scales[:1], planes, is_leaf=lambda x: type(x) is tuple)
    actual = features(planes, jnp.asarray(point), jnp.asarray(BOUNDS), jnp.asarray(TIMES), CFG)
    np.testing.assert_allclose(actual, oracle(planes, point, TIMES, CFG), rtol=1e-12)


def test_points_outside_the_box_have_finite_features_and_no_gradient():
    points = jnp.asarray(random_points()).at[:3].set(np.array([[9.0, 1.0, 2.2], [-1e30, 1e30, 1e30], [0.3, 1.0, 2.2]]))
    value = features(random_planes(), points, jnp.asarray(BOUNDS), jnp.asarray(TIMES), CFG)
    gradient = point_gradient(points, random_planes(), jnp.asarray(BOUNDS), jnp.asarray(TIMES))
    assert np.isfinite(value).all()
    assert np.isfinite(gradient).all()
    np.testing.assert_array_equal(gradient[0, 0], 0)
    np.testing.assert_array_equal(gradient[1], 0)
    assert np.all(gradient[2] != 0)


def test_a_box_without_extent_along_an_axis_ignores_that_axis():
    flat = jnp.asarray(np.array([[-1.0, 2.0, 2.0], [1.0, 2.0, 2.5]]))
    points = jnp.asarray(random_points())
    f = lambda x: features(random_planes(), x, flat, jnp.asarray(TIMES), CFG)
    np.testing.assert_array_equal(f(points), f(points.at[:, 1].set(2.0)))
    gradient = point_gradient(points, random_planes(), flat, jnp.asarray(TIMES))
    assert np.isfinite(gradient).all()
    np.testing.assert_array_equal(gradient[:, 1], 0)


def test_features_at_one_time_do_not_depend_on_other_times():
    planes, points = random_planes(), jnp.asarray(random_points())
    both = features(planes, points, jnp.asarray(BOUNDS), jnp.asarray(TIMES), CFG)
    for view, t in enumerate(TIMES):
        alone = features(planes, points, jnp.asarray(BOUNDS), jnp.array([t]), CFG)[0]
        np.testing.assert_allclose(both[view], alone, rtol=1e-14)


def test_initial_field_does_not_depend_on_time_and_follows_the_configuration():
    planes = hexplane.init(jax.random.key(0), dataclasses.replace(CFG, time_size=None), 21)
    assert [p.shape for p in planes.space] == [(3, 4, 4, 2), (3, 8, 8, 2)]
    assert [p.shape for p in planes.time] == [(3, 10, 4, 2), (3, 10, 8, 2)]
    assert all(p.min() >= 0.1 and p.max() <= 0.5 and p.std() > 0.05 for p in planes.space)
    assert not np.allclose(planes.space[0][0], planes.space[0][1])
    moved = features(planes, jnp.asarray(random_points()), jnp.asarray(BOUNDS), jnp.asarray(TIMES), CFG)
    np.testing.assert_allclose(moved[0], moved[1], rtol=1e-12)
    assert hexplane.init(jax.random.key(0), dataclasses.replace(CFG, time_size=None), 1).time[0].shape[1] == 2


@pytest.mark.parametrize("change", [{"plane_size": 1}, {"time_size": 1}, {"time_size": 0}])
def test_an_axis_of_one_cell_is_refused(change):
    with pytest.raises(ValueError, match="at least 2 cells"):
        hexplane.init(jax.random.key(0), dataclasses.replace(CFG, **change), 10)


def test_regularisers_match_their_definition():
    planes = random_planes()
    second = lambda p: np.mean([(p[i + 1] - 2 * p[i] + p[i - 1]) ** 2 for i in range(1, len(p) - 1)])
    expected = (
        sum(second(p) for stack in planes.space for p in np.asarray(stack)),
        sum(second(p) for stack in planes.time for p in np.asarray(stack)),
        sum(np.abs(1 - p).mean() for stack in planes.time for p in np.asarray(stack)),
    )
    np.testing.assert_allclose(hexplane.regularisers(planes), expected, rtol=1e-12)
    check_grads(jax.jit(hexplane.regularisers), (planes,), order=1, modes=["fwd", "rev"])


def test_regularisers_of_a_ramp_and_of_two_instants_are_zero():
    ramp = lambda size: jnp.broadcast_to(jnp.arange(float(size))[None, :, None, None], (3, size, 4, 2))
    np.testing.assert_array_equal(hexplane.regularisers(HexPlane((ramp(4),), (ramp(6),)))[:2], 0)
    np.testing.assert_array_equal(hexplane.regularisers(HexPlane((ramp(4),), (ramp(2),)))[1], 0)


def test_with_a_rim_features_vary_outside_the_box_too():
    cfg = dataclasses.replace(CFG, box_rim=0.25)
    low, high = BOUNDS
    ramp = np.linspace(0, 1, 801)[:, None]
    inside = low + ramp * (high - low)
    planes = random_planes()
    lookup = lambda points: hexplane.features(planes, jnp.asarray(points), jnp.asarray(BOUNDS), jnp.asarray(TIMES), cfg)
    middle = 0.5 * (low + high)
    shrunk = features(
        planes, jnp.asarray(middle + 0.75 * (inside - middle)), jnp.asarray(BOUNDS), jnp.asarray(TIMES), CFG
    )
    np.testing.assert_allclose(lookup(inside), shrunk, rtol=1e-9)
    outer = [middle + distance * (high - low) * np.array([[0.6, -0.7, 0.8]]) for distance in (0.5, 1, 2, 4, 1e3, 1e30)]
    found = [np.asarray(lookup(point)) for point in outer]
    assert all(np.abs(a - b).max() > 1e-6 for a, b in itertools.pairwise(found[:-1]))
    assert all(np.isfinite(x).all() for x in found)
    gradient = jax.grad(lambda point: lookup(point).sum())(jnp.asarray(outer[3]))
    assert np.all(gradient != 0)
    step = 1e-6 * (high - low)
    edge = [np.asarray(lookup((high + k * step)[None])) for k in (-1, 0, 1)]
    np.testing.assert_allclose(edge[2] - edge[1], edge[1] - edge[0], rtol=1e-2, atol=1e-12)
