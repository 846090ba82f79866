"""Deforming and lighting the Gaussians: Eqs. 1-4 together, dead rows, gradients."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.model import hexplane, networks
from l2dgs_jax.model.deformation import MAX_GROWTH, deform, path_weights
from l2dgs_jax.types import Camera, Gaussians, Scene, SceneParams

CFG = ModelConfig(
    plane_size=3, plane_scales=(1, 2), plane_channels=2, time_size=3, hidden=5, sh_degree=2, opacity_head=True
)
BOUNDS = jnp.asarray(np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
N = 6


@partial(jax.jit, static_argnames=("cfg", "moving"))
def deform_jit(params, cameras, alive, bounds, cfg, extent=1.0, path_of=None, **options):
    return deform(Scene(params, alive, bounds, jnp.asarray(extent), path_of), cameras, cfg, **options)


@partial(jax.jit, static_argnums=2)
def field_and_motion(params, times, cfg):
    field = hexplane.features(params.hexplane, params.gaussians.means, BOUNDS, times, cfg)
    hidden, motion = networks.apply_heads(params.heads, field)
    return motion, networks.apply_ocd(params.ocd, hidden)


def initial(key):
    """Initial values of everything but the Gaussians."""
    return (
        hexplane.init(key, CFG, 9),
        networks.init_heads(key, 4, CFG),
        networks.init_ocd(key, CFG),
        networks.init_bafe(key, None),
    )


def random_params(seed=0):
    rng = np.random.default_rng(seed)
    draw = lambda *shape: jnp.asarray(rng.normal(0.1, 0.4, shape))
    gaussians = Gaussians(
        means=jnp.asarray(rng.uniform(-0.9, 0.9, (N, 3))),
        quats=draw(N, 4),
        log_scales=draw(N, 3),
        logit_opacities=draw(N),
        illumination_dc=draw(N, 1),
        illumination_rest=draw(N, 8),
        reflectance=draw(N, 3),
        attenuation=draw(N, 2),
    )
    shared = jax.tree.map(lambda leaf: draw(*leaf.shape), jax.eval_shape(initial, jax.random.key(0)))
    params = SceneParams(gaussians, *shared)
    # With this bias most factors a_j are positive before the ReLU.
    out = params.ocd.out._replace(bias=jnp.ones(9))
    return params._replace(ocd=params.ocd._replace(out=out))


def views(seed=3, times=(0.2, 0.7)):
    rng = np.random.default_rng(seed)
    viewmat = np.tile(np.eye(4), (len(times), 1, 1))
    for pose in viewmat:
        pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, 3] = rng.normal(0, 3, 3)
    return Camera(jnp.asarray(viewmat), jnp.asarray(np.tile(np.eye(3), (len(times), 1, 1))), jnp.asarray(times))


ALIVE = jnp.ones(N, bool)
deformed = partial(deform_jit, alive=ALIVE, bounds=BOUNDS, cfg=CFG, sh_degree_active=2)


@partial(jax.jit, static_argnames="moving")
@partial(jax.grad, has_aux=True)
def gradient_of_visible(params, alive, moving):
    """Gradient of a sum over living Gaussians; as in a rasterizer, the others do not count."""
    moved = deformed(params, alive=alive, cameras=views(), moving=moving)
    seen = jax.tree.map(lambda x: jnp.where(alive.reshape(1, -1, *[1] * (x.ndim - 2)), x, 0).sum(), moved)
    return sum(seen), moved


def plain_basis(v):
    """The first nine real spherical harmonics, from a table."""
    x, y, z = v
    return np.array(
        [
            np.sqrt(1 / np.pi) / 2,
            *np.sqrt(3 / np.pi) / 2 * np.array([-y, z, -x]),
            *np.sqrt(15 / np.pi) / 2 * np.array([x * y, -y * z]),
            np.sqrt(5 / np.pi) / 4 * (3 * z * z - 1),
            *np.sqrt(15 / np.pi) / 2 * np.array([-x * z, (x * x - y * y) / 2]),
        ]
    )


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("active", [0, 1, 2])
def test_illumination_is_eq_3(moving, active):
    params, cameras = random_params(), views()
    actual = deformed(params, cameras=cameras, moving=moving, sh_degree_active=jnp.array(active)).illumination
    _, factors = field_and_motion(params, cameras.time, CFG)
    factors, gaussians = jax.tree.map(np.asarray, (factors, params.gaussians))
    expected = np.zeros((2, N))
    for view, pose in enumerate(np.asarray(cameras.viewmat)):
        centre = np.linalg.inv(pose)[:3, 3]
        for i, mean in enumerate(gaussians.means):
            direction = (mean - centre) / np.linalg.norm(mean - centre)
            b = np.concatenate([gaussians.illumination_dc[i], gaussians.illumination_rest[i]])
            a = factors[view, i] if moving else np.ones(9)
            terms = (a * b * plain_basis(direction))[: (active + 1) ** 2]
            expected[view, i] = max(0.5 + terms.sum(), 0)
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-12)
    assert (expected > 0).any()


def test_without_ocd_net_illumination_does_not_depend_on_time():
    params, cameras = random_params(), views(times=(0.2, 0.7))
    same_camera = cameras._replace(viewmat=cameras.viewmat[:1].repeat(2, 0))
    lit = lambda **options: deformed(params, cameras=same_camera, **options).illumination
    without = lit(cfg=dataclasses.replace(CFG, ocd=False), moving=True)
    np.testing.assert_allclose(without, lit(moving=False), rtol=1e-12)
    assert np.ptp(lit(moving=True), axis=0).max() > 1e-3


@pytest.mark.parametrize("active", [0, 1, 2])
def test_colours_without_a_decomposition_are_spherical_harmonics(active):
    params, cameras = random_params(), views()
    rest = jnp.asarray(np.random.default_rng(5).normal(0, 0.3, (N, 3, 8)))
    params = params._replace(gaussians=params.gaussians._replace(color_rest=rest))
    actual = deformed(params, cameras=cameras, moving=True, sh_degree_active=jnp.array(active)).reflectance
    for view, pose in enumerate(np.asarray(cameras.viewmat)):
        towards = np.asarray(params.gaussians.means) - np.linalg.inv(pose)[:3, 3]
        basis = np.stack([plain_basis(d / np.linalg.norm(d)) for d in towards])[:, 1 : (active + 1) ** 2]
        seen = params.gaussians.reflectance + (rest[..., : basis.shape[1]] * basis[:, None]).sum(-1)
        np.testing.assert_allclose(actual[view], np.maximum(seen, 0), rtol=1e-9, atol=1e-12)


def test_illumination_has_an_offset_and_is_never_negative():
    params = random_params()
    dark = params._replace(gaussians=params.gaussians._replace(illumination_dc=jnp.full((N, 1), -50.0)))
    lit = lambda p, value: (
        deformed(p, cameras=views(), cfg=dataclasses.replace(CFG, illumination_offset=value), moving=False).illumination
    )
    np.testing.assert_array_equal(lit(dark, 0.5), 0)
    np.testing.assert_allclose(lit(params, 5.0) - lit(params, 4.0), 1, rtol=1e-12)


def test_coarse_stage_is_the_canonical_scene_in_every_view():
    params = random_params()
    g, moved = params.gaussians, deformed(params, cameras=views(), moving=False)
    expected = {
        "means": g.means,
        "quats": g.quats,
        "scales": np.exp(g.log_scales),
        "opacities": 1 / (1 + np.exp(-g.logit_opacities)),
        "reflectance": g.reflectance,
        "attenuation": g.attenuation,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(getattr(moved, name), np.stack([value, value]), rtol=1e-14, err_msg=name)


def test_fine_stage_adds_the_outputs_of_the_heads_to_the_raw_parameters():
    params, cameras = random_params(), views()
    g, moved = params.gaussians, deformed(params, cameras=cameras, moving=True)
    motion, _ = field_and_motion(params, cameras.time, CFG)
    g, motion = jax.tree.map(np.asarray, (g, motion))
    np.testing.assert_allclose(moved.means, g.means[None] + motion.means, rtol=1e-12)
    np.testing.assert_allclose(moved.quats, g.quats[None] + motion.quats, rtol=1e-12)
    np.testing.assert_allclose(moved.scales, np.exp(g.log_scales[None] + motion.log_scales), rtol=1e-12)
    logits = g.logit_opacities[None] + motion.logit_opacities
    np.testing.assert_allclose(moved.opacities, 1 / (1 + np.exp(-logits)), rtol=1e-12)
    assert np.abs(moved.means[0] - moved.means[1]).max() > 1e-3
    undeformed = deformed(params, cameras=cameras, moving=False)
    for name in ("reflectance", "attenuation"):
        np.testing.assert_array_equal(getattr(moved, name), getattr(undeformed, name))


def test_bounded_growth_of_scales_starts_like_exponential_growth_and_ends_at_its_bound():
    bounded = dataclasses.replace(CFG, scale_growth="bounded")
    params, cameras = random_params(), views()
    scales, canonical = params.heads.scale, np.exp(np.asarray(params.gaussians.log_scales))[None]
    for size in (1.0, 100.0):
        last = scales[-1]._replace(weight=size * scales[-1].weight, bias=size * (scales[-1].bias - 0.7))
        heads = params.heads._replace(scale=(*scales[:-1], last))
        motion, _ = field_and_motion(params._replace(heads=heads), cameras.time, CFG)
        x = np.asarray(motion.log_scales)
        assert x.min() < 0 < x.max()
        moved = deformed(params._replace(heads=heads), cfg=bounded, cameras=cameras, moving=True)
        expected = canonical * np.exp(np.where(x > 0, MAX_GROWTH * np.tanh(x / MAX_GROWTH), x))
        np.testing.assert_allclose(moved.scales, expected, rtol=1e-12)
    scaled = lambda head: (
        deformed(
            params._replace(heads=params.heads._replace(scale=head)), cfg=bounded, cameras=cameras, moving=True
        ).scales
    )
    check_grads(scaled, (scales,), 1, ["rev"], eps=1e-6)


def test_without_an_opacity_head_opacity_does_not_depend_on_time():
    params = random_params()
    params = params._replace(heads=params.heads._replace(opacity=None))
    moving, still = (deformed(params, cameras=views(), moving=moving) for moving in (True, False))
    np.testing.assert_array_equal(moving.opacities, still.opacities)
    assert np.any(moving.means != still.means)


def test_identity_start_makes_the_first_fine_step_equal_to_the_last_coarse_one():
    cfg = dataclasses.replace(CFG, identity_start=True)
    heads, ocd = networks.init_heads(jax.random.key(0), 4, cfg), networks.init_ocd(jax.random.key(0), cfg)
    params = random_params()._replace(heads=heads, ocd=ocd)
    fine, coarse = (deformed(params, cameras=views(), moving=moving) for moving in (True, False))
    jax.tree.map(np.testing.assert_array_equal, fine, coarse)


def test_dead_rows_are_invisible_and_get_no_gradient_even_when_they_hold_garbage():
    params, dead = random_params(), np.array([False, True, False, False, True, False])
    alive = jnp.asarray(~dead)
    fill = lambda rows: jnp.asarray(np.where(dead.reshape(-1, *[1] * (rows.ndim - 1)), np.inf, rows))
    garbage = jax.tree.map(fill, params.gaussians)
    gradient, moved = gradient_of_visible(params._replace(gaussians=garbage), alive, True)
    expected, _ = gradient_of_visible(params, alive, True)
    opacities = np.asarray(moved.opacities)
    np.testing.assert_array_equal(opacities[:, dead], 0)
    assert np.all(opacities[:, ~dead] > 0)
    for leaf in jax.tree.leaves(gradient.gaussians):
        np.testing.assert_array_equal(np.asarray(leaf)[dead], 0)
        assert np.any(np.asarray(leaf)[~dead] != 0)
    jax.tree.map(np.testing.assert_array_equal, gradient, expected)


def gated(params, logits):
    return params._replace(gaussians=params.gaussians._replace(gate=jnp.asarray(np.broadcast_to(logits, N))))


def test_the_gate_interpolates_between_no_motion_and_full_motion():
    params, cameras = random_params(), views()
    ungated, undeformed = (deformed(params, cameras=cameras, moving=moving) for moving in (True, False))
    logits = np.array([40.0, -40.0, 0.0, 40.0, -40.0, 0.0])
    moved = deformed(gated(params, logits), cameras=cameras, moving=True)
    for name in ("means", "quats"):
        ends = [np.asarray(getattr(x, name)) for x in (undeformed, ungated)]
        share = np.array([1, 0, 0.5, 1, 0, 0.5])[None, :, None]
        np.testing.assert_allclose(getattr(moved, name), (1 - share) * ends[0] + share * ends[1], atol=1e-12)
    for name in moved._fields:
        for row, reference in ((0, ungated), (1, undeformed), (3, ungated), (4, undeformed)):
            value, expected = (getattr(x, name)[:, row] for x in (moved, reference))
            np.testing.assert_allclose(value, expected, atol=1e-12, err_msg=name)


def test_what_is_behind_a_shut_gate_stands_still_and_its_gate_stays_shut():
    params, cameras = random_params(), views()
    logits = np.array([1.0, -3.0, 2.0, 0.5, -4.0, -1.0])
    cfg = dataclasses.replace(CFG, shut_gates=0.3)
    shut = 1 / (1 + np.exp(-logits)) < 0.3
    assert 0 < shut.sum() < N
    undeformed, fading, moved = (
        deformed(gated(params, logits), cameras=cameras, moving=moving, cfg=own)
        for moving, own in ((False, CFG), (True, CFG), (True, cfg))
    )
    for name in moved._fields:
        value, still, free = (np.asarray(getattr(x, name)) for x in (moved, undeformed, fading))
        np.testing.assert_array_equal(value[:, shut], still[:, shut], err_msg=name)
        np.testing.assert_array_equal(value[:, ~shut], free[:, ~shut], err_msg=name)

    def f(params):
        return deformed(params, cameras=cameras, moving=True, cfg=cfg)

    check_grads(f, (gated(params, logits),), 1, ["rev"], eps=1e-6)
    gradient = jax.grad(lambda params: sum(x.sum() for x in f(params)))(gated(params, logits)).gaussians.gate
    np.testing.assert_array_equal(gradient != 0, ~shut)


def test_motion_scales_with_the_unit_of_lengths():
    params, cameras = random_params(), views()
    offset = lambda cfg, extent: (
        deformed(params, cameras=cameras, cfg=cfg, extent=extent, moving=True).means - params.gaussians.means[None]
    )
    by_depth = dataclasses.replace(CFG, unit="depth")
    np.testing.assert_allclose(offset(by_depth, 3.0), 3 * offset(CFG, 3.0), rtol=1e-9)
    np.testing.assert_array_equal(offset(CFG, 3.0), offset(CFG, 1.0))


@pytest.mark.parametrize("moving", [False, True])
def test_gradients(moving):
    params, cameras = random_params(), views()

    def f(params, viewmat, time):
        return deformed(params, cameras=Camera(viewmat, cameras.K, time), moving=moving)

    check_grads(f, (params, cameras.viewmat, cameras.time), 1, ["rev"], eps=1e-6)


@pytest.mark.parametrize("moving", [False, True])
def test_extreme_inputs_give_finite_values_and_gradients(moving):
    params, cameras = random_params(), views()
    pose = np.asarray(cameras.viewmat[0])
    means = np.array(params.gaussians.means)
    means[:4] = [1e12] * 3, [-1e12] * 3, -pose[:3, :3].T @ pose[:3, 3], [1.0] * 3
    gaussians = params.gaussians._replace(
        means=jnp.asarray(means),
        quats=jnp.asarray(np.zeros((N, 4))),
        log_scales=jnp.asarray(np.full((N, 3), -200.0)),
        logit_opacities=jnp.asarray(np.array([1e3, -1e3, 0.0, 0.0, 0.0, 0.0])),
    )
    gradient, moved = gradient_of_visible(params._replace(gaussians=gaussians), ALIVE, moving)
    assert all(np.isfinite(x).all() for x in moved)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_single_precision_is_kept():
    single = lambda tree: jax.tree.map(lambda x: x.astype("float32"), tree)
    moved = deformed(single(random_params()), bounds=BOUNDS.astype("float32"), cameras=single(views()), moving=True)
    assert {x.dtype for x in moved} == {np.dtype("float32")}


KNOTS = 4
LIFETIMES = np.array([[0, 1], [0.2, 0.7], [-1, 0.4], [0.8, 0.9], [-np.inf, np.inf], [-np.inf, np.inf]])
PATH_OF = np.array([2, 0, 1, 0, 0, 2], np.int32)  # two Gaussians share a path; the last two follow none
PATHS = np.random.default_rng(2).normal(0, 0.3, (3, KNOTS, 3))


def with_paths(times, paths=PATHS, lifetimes=LIFETIMES):
    """The Gaussians without and with paths and lifetimes."""
    params, cameras = random_params(), views(times=times)
    gaussians = params.gaussians._replace(lifetimes=jnp.asarray(lifetimes))
    followed = params._replace(gaussians=gaussians, paths=jnp.asarray(paths))
    without = deformed(params, cameras=cameras, moving=False)
    return without, deformed(followed, cameras=cameras, moving=False, path_of=jnp.asarray(PATH_OF))


@pytest.mark.parametrize("knots", [2, 3, 4, 9])
def test_gaussians_follow_their_paths(knots):
    times = (0.0, 0.1, 1 / 3, 0.5, 0.85, 0.99, 1.0)
    paths = np.random.default_rng(3).normal(0, 0.3, (3, knots, 3))
    without, moved = with_paths(times, paths)
    expected = np.einsum("vk,nkc->vnc", path_weights(jnp.asarray(times), knots), paths[PATH_OF])
    expected = expected * np.isfinite(LIFETIMES[:, :1])
    np.testing.assert_allclose(moved.means - without.means, expected, atol=1e-12)


def test_paths_are_smooth_and_straight_for_evenly_spaced_knots():
    times = np.linspace(0, 1, 301)
    weights = np.asarray(path_weights(jnp.asarray(times), 6))
    np.testing.assert_allclose(weights.sum(-1), 1)
    inner = (times > 0.21) & (times < 0.79)
    np.testing.assert_allclose((weights @ np.linspace(0, 1, 6))[inner], times[inner], atol=1e-12)
    jerk = np.diff(weights, 3, axis=0)[61:-61] / times[1] ** 3
    assert np.abs(jerk).max() < 3.01 * 5**3  # bounded: the curvature is continuous
    check_grads(lambda t: path_weights(jnp.asarray(t), 6), (np.array([0.13, 0.52, 0.9]),), 1)


def test_gaussians_fade_in_and_out_at_the_ends_of_their_lifetimes():
    without, moved = with_paths((0.1, 0.3, 0.45, 0.5, 0.95))
    expected = [
        [1, 0, 1, 0, 1, 1],
        [1, 1, 1, 0, 1, 1],
        [1, 1, 0.4, 0, 1, 1],
        [1, 1, 0, 0, 1, 1],
        [1, 0, 0, 0.4, 1, 1],
    ]
    np.testing.assert_allclose(moved.opacities / without.opacities, expected, atol=1e-9)


@pytest.mark.parametrize(("knots", "times"), [(KNOTS, (0.15, 0.62)), (9, (0.19, 0.42))])
def test_paths_and_lifetimes_carry_gradients(knots, times):
    start = np.random.default_rng(4).normal(0, 0.3, (3, knots, 3))

    def total(paths, lifetimes):
        _, moved = with_paths(times, paths, jnp.concatenate([lifetimes, jnp.asarray(LIFETIMES[4:])]))
        return jnp.sin(3 * moved.means).sum() + jnp.square(moved.opacities).sum()

    check_grads(total, (start, LIFETIMES[:4]), 1, modes=["rev"])
    gradient = jax.grad(total, 1)(jnp.asarray(start), jnp.asarray(LIFETIMES[:4]))
    assert np.isfinite(gradient).all()
    assert np.abs(gradient).max() > 0.1
