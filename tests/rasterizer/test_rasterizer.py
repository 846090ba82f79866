from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.kernels import use_kernels
from l2dgs_jax.rasterizer import rasterize
from l2dgs_jax.rasterizer.reference import rasterize_dense

GOLDEN = Path(__file__).parent / "golden"
# Each other form takes another compilation: tests/kernels compare all forms, and these only the slow tests.
ACCELERATOR = pytest.param("accelerator", marks=pytest.mark.slow)
REFERENCE = pytest.param("reference", marks=pytest.mark.slow)
NAMES = ("means", "quats", "scales", "opacities", "features", "viewmat", "K")
WIDTH, HEIGHT, CAPACITY = 37, 23, 4096  # enough tiles for the form that CPUs run


def scene(seed=0, count=40, width=WIDTH, height=HEIGHT):
    """Random Gaussians in front of a camera, opaque enough that some pixels end early."""
    random = np.random.default_rng(seed)
    z = random.uniform(2, 5, count)
    means = np.stack([random.uniform(-0.6, 0.6, count) * z, random.uniform(-0.4, 0.4, count) * z, z], axis=-1)
    viewmat = np.eye(4)
    viewmat[:3, 3] = [0.1, -0.05, 0.2]
    arrays = (
        means,
        random.normal(size=(count, 4)),
        np.exp(random.normal(np.log(0.5), 0.4, (count, 3))),
        random.uniform(0.1, 1, count),
        random.uniform(size=(count, 2)),
        viewmat,
        np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]]),
    )
    return tuple(jnp.asarray(x) for x in arrays)


def stacked(seeds):
    return tuple(jnp.stack(x) for x in zip(*(scene(seed) for seed in seeds), strict=True))


def weighted_loss(values, seed=9):
    """A loss with random weights: different for the entries of a view, the same for all views."""
    random = np.random.default_rng(seed)
    noise = [random.normal(size=x.shape[values[1].ndim - 2 :]).astype(x.dtype) for x in values]
    return sum(jnp.sum(x * jnp.broadcast_to(w, x.shape)) for x, w in zip(values, noise, strict=True))


def images(*arrays, width=WIDTH, height=HEIGHT):
    output = rasterize(*arrays, width, height, pair_capacity=CAPACITY)
    return output.features, output.alpha, output.depth


def with_gradients(draw):
    """A compiled function of the images from `draw` and the gradients of their loss by every array."""

    @partial(jax.jit, static_argnames=("width", "height"))
    def run(*arrays, width=WIDTH, height=HEIGHT):
        loss = lambda *a: (weighted_loss(values := draw(*a, width=width, height=height)), values)
        (_, values), gradients = jax.value_and_grad(loss, tuple(range(7)), has_aux=True)(*arrays)
        return values, gradients

    return run


fast, dense = with_gradients(images), with_gradients(rasterize_dense)


def assert_close(actual, expected, tolerance=1e-9):
    for a, e in zip(actual, expected, strict=True):
        assert a.shape == e.shape
        assert np.linalg.norm(np.asarray(a) - np.asarray(e)) <= tolerance * np.linalg.norm(e)


@partial(jax.jit, static_argnames=("width", "height"))
def golden_loss(arrays, weights, width, height):
    def loss(probe, *arrays):
        output = rasterize(*arrays, width, height, means2d_probe=probe, pair_capacity=20480)
        drawn = output.features, output.alpha, output.depth
        return sum(jnp.sum(w * x) for w, x in zip(weights, drawn, strict=True)), output

    probe = jnp.zeros_like(arrays[0][:, :2])
    (_, output), gradients = jax.value_and_grad(loss, tuple(range(8)), has_aux=True)(probe, *arrays)
    return output, gradients


@pytest.mark.parametrize(
    ("name", "dtype", "form"),
    [
        ("s500_96x64", jnp.float64, None),
        ("s500_96x64", jnp.float32, None),
        ("s500o_96x64", jnp.float32, None),
        ("s2000_160x96", jnp.float32, None),
        pytest.param("s500_96x64", jnp.float32, "accelerator", marks=pytest.mark.slow),
        ("s500o_96x64", jnp.float32, "accelerator"),
        pytest.param("s500o_96x64", jnp.float64, "reference", marks=pytest.mark.slow),
    ],
)
def test_images_and_gradients_match_the_golden_scenes(name, dtype, form):
    golden = np.load(GOLDEN / f"{name}.npz")
    arrays = [jnp.asarray(golden[f"in_{key}"], dtype) for key in NAMES]
    weights = [jnp.asarray(golden[f"in_w_{key}"], dtype) for key in ("features", "alpha", "depth")]
    with use_kernels(form):
        output, gradients = golden_loss(arrays, weights, int(golden["in_width"]), int(golden["in_height"]))
    assert not output.overflow
    clear = ~golden["out_ambiguous"]
    assert clear.mean() > 0.95
    for actual, key in ((output.features, "features"), (output.alpha, "alpha"), (output.depth, "depth_acc")):
        assert actual.dtype == dtype
        np.testing.assert_allclose(np.asarray(actual)[clear], golden[f"out_{key}"][clear], rtol=0, atol=1e-5)
    for gradient, key in zip(gradients, ("means2d", *NAMES), strict=True):
        assert gradient.dtype == dtype
        error = np.linalg.norm(np.asarray(gradient) - golden[f"out_g_{key}"])
        assert error <= 1e-4 * np.linalg.norm(golden[f"out_g_{key}"]), key


@pytest.mark.parametrize("seed", range(3))
def test_agrees_with_the_dense_oracle(seed):
    arrays = scene(seed)
    values, gradients = fast(*arrays)
    expected, expected_gradients = dense(*arrays)
    assert_close(values, expected)
    assert_close(gradients, expected_gradients)
    assert values[1].max() > 0.999  # some pixels end early


def test_an_image_of_one_pixel_is_rendered():
    arrays = scene(4, width=1, height=1)
    values, gradients = fast(*arrays, width=1, height=1)
    assert values[1].shape == (1, 1)
    assert values[1] > 0.1
    assert_close(values, jax.jit(rasterize_dense, static_argnums=(7, 8))(*arrays, 1, 1))
    assert all(np.all(np.isfinite(x)) and np.any(x != 0) for x in gradients)


@pytest.mark.parametrize("form", [REFERENCE, "accelerator"])
def test_every_form_agrees(form):
    arrays = scene(13)
    values, gradients = fast(*arrays)
    with use_kernels(form):
        other_values, other_gradients = fast(*arrays)
    assert_close(other_values, values, 1e-12)
    assert_close(other_gradients, gradients, 1e-11)


# One tile, as many tiles as a block for CPUs, one more than that, and a few blocks with a remainder.
@pytest.mark.parametrize(("width", "height"), [(8, 8), (32, 16), (72, 8), (33, 39)])
def test_full_and_partial_blocks_of_tiles_agree_with_the_oracle(width, height):
    arrays = scene(10, width=width, height=height)
    values, gradients = fast(*arrays, width=width, height=height)
    expected, expected_gradients = dense(*arrays, width=width, height=height)
    assert_close(values, expected)
    assert_close(gradients, expected_gradients)


def test_gradients_match_finite_differences():
    # Wide, faint, few: no contribution is near a threshold, where the image jumps.
    means, quats, scales, _, features, viewmat, K = (x[:3] if i < 5 else x for i, x in enumerate(scene(7)))
    arrays = means * jnp.array([0.1, 0.1, 1.0])[None], quats, 4 + scales, jnp.array([0.3, 0.5, 0.4]), features
    check_grads(
        jax.jit(lambda *a: images(*a, viewmat, K, width=9, height=5)), arrays, order=1, modes=("rev",), eps=1e-5
    )


@pytest.mark.parametrize("form", [None, ACCELERATOR])
@pytest.mark.parametrize("batch", [fast, jax.jit(jax.vmap(fast))], ids=["views", "vmap"])
def test_a_batch_equals_a_loop(batch, form):
    arrays = stacked(range(3))
    alone = [fast(*(x[v] for x in arrays)) for v in range(3)]
    with use_kernels(form):
        together = batch(*arrays)
    for actual, expected in zip(together, jax.tree.map(lambda *x: jnp.stack(x), *alone), strict=True):
        assert_close(actual, expected, 1e-12)


def test_views_may_share_their_gaussians():
    *gaussians, viewmat, K = scene(14)
    viewmats = jnp.stack([viewmat, viewmat.at[0, 3].add(0.3)])
    Ks = jnp.stack([K, K.at[0, 0].add(4)])
    values, gradients = fast(*gaussians, viewmats, Ks)
    alone = [fast(*gaussians, v, k) for v, k in zip(viewmats, Ks, strict=True)]
    assert_close(values, jax.tree.map(lambda *x: jnp.stack(x), *(values for values, _ in alone)), 1e-12)
    assert_close(gradients[:5], [a + b for a, b in zip(*(gradients[:5] for _, gradients in alone), strict=True)], 1e-11)
    with pytest.raises(ValueError, match="expected as many, or shared ones"):
        rasterize(*(jnp.stack([x] * 3) for x in gaussians), viewmats, Ks, WIDTH, HEIGHT)


def test_expected_depth_is_accumulated_depth_over_alpha():
    golden = np.load(GOLDEN / "s500_96x64.npz")
    arrays = [jnp.asarray(golden[f"in_{key}"]) for key in NAMES]
    drawn = rasterize(*arrays, int(golden["in_width"]), int(golden["in_height"]), depth_mode="expected")
    clear = ~golden["out_ambiguous"] & (golden["out_alpha"] > 0.01)
    expected = golden["out_depth_acc"][clear] / golden["out_alpha"][clear]
    np.testing.assert_allclose(np.asarray(drawn.depth)[clear], expected, rtol=1e-4)


def test_the_near_plane_hides_and_the_blur_widens():
    means, *rest = scene(15)
    depths = means[:, 2] + rest[-2][2, 3]
    middle = float(jnp.median(depths))
    hidden = rasterize(means, *rest, WIDTH, HEIGHT, near_plane=middle)
    np.testing.assert_array_equal(
        hidden.radii > 0, (depths > middle) & (rasterize(means, *rest, WIDTH, HEIGHT).radii > 0)
    )
    dot = (jnp.array([[0.0, 0.0, 3.0]]), jnp.ones((1, 4)), jnp.full((1, 3), 1e-6), jnp.ones(1), jnp.ones((1, 1)))
    # A point is a blur of that variance: alpha at a distance of d pixels is exp(-d^2 / (2 eps2d)).
    camera = jnp.eye(4), jnp.array([[10.0, 0, 8.5], [0, 10, 8.5], [0, 0, 1]])
    for eps2d in (0.3, 1.5):
        alpha = rasterize(*dot, *camera, 17, 17, eps2d=eps2d).alpha
        np.testing.assert_allclose(alpha[8, 9], np.exp(-0.5 / eps2d), rtol=1e-5)


@pytest.mark.parametrize("form", [None, ACCELERATOR])
def test_no_gaussians_give_a_black_image(form):
    means, quats, scales, opacities, features, viewmat, K = scene(1)
    empty = [x[:0] for x in (means, quats, scales, opacities, features)]
    with use_kernels(form):
        values, gradients = fast(*empty, viewmat, K)
    assert all(not x.any() for x in (*values, *gradients))
    assert values[0].shape == (HEIGHT, WIDTH, 2)


def test_vmap_over_features_or_cotangents_alone_equals_a_loop():
    *geometry, features, viewmat, K = scene(12)
    draw = lambda features: rasterize(*geometry, features, viewmat, K, WIDTH, HEIGHT, pair_capacity=CAPACITY).features
    image, pullback = jax.vjp(draw, features)
    many = jnp.stack([features, 2 * features, features + 1])
    cotangents = jnp.stack([image, image**2, image - 0.5])
    # First only the features differ, then only the cotangents; then two axes are vmapped.
    assert_close([jax.jit(jax.vmap(draw))(many)], [jnp.stack([draw(x) for x in many])], 1e-12)
    (together,) = jax.vmap(pullback)(cotangents)
    assert_close([together], [jnp.stack([pullback(x)[0] for x in cotangents])], 1e-12)
    twice = jax.jit(jax.vmap(jax.vmap(draw)))(jnp.stack([many, -many]))
    assert_close([twice], [jnp.stack([draw(x) for x in (*many, *-many)]).reshape(twice.shape)], 1e-12)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_extreme_inputs_give_finite_values_and_gradients(dtype):
    means, quats, scales, opacities, features, viewmat, K = (x.astype(dtype) for x in scene(5))
    opacities = opacities.at[:10].set(0).at[10:30].set(1)
    quats = quats.at[::4].set(0)
    scales = scales.at[1].set(0).at[2].set(100)
    means = means.at[3].set(-viewmat[:3, 3]).at[4].multiply(-1)
    values, gradients = fast(means, quats, scales, opacities, features, viewmat, K)
    for x in (*values, *gradients):
        assert x.dtype == dtype
        assert np.all(np.isfinite(x))
    assert np.all(gradients[3][:10] == 0)  # opacity 0 is inert: that is how dead rows are hidden
    assert np.linalg.norm(gradients[3][10:30]) > 0


def test_nothing_is_drawn_behind_the_camera():
    means, *rest = scene(6)
    values, gradients = fast(-means, *rest)
    output = rasterize(-means, *rest, WIDTH, HEIGHT)
    for x in (*values, *gradients, output.radii, output.pairs):
        assert np.all(x == 0)


@pytest.mark.parametrize("form", [None, REFERENCE, ACCELERATOR])
def test_nan_is_not_hidden(form):
    arrays = list(scene(8))
    for position in range(5):
        broken = list(arrays)
        broken[position] = broken[position].at[7].set(jnp.nan)
        with use_kernels(form):
            assert np.isnan(fast(*broken)[0][0]).any(), NAMES[position]


def test_radii_tightly_bound_what_is_drawn():
    count = 60
    means, quats, scales, opacities, _, viewmat, K = scene(11, count)
    one_hot = jnp.eye(count)  # a channel per Gaussian shows where it contributes
    scales, opacities = 0.2 * scales, opacities.at[::5].set(0.003)
    output = rasterize(means, quats, scales, opacities, one_hot, viewmat, K, WIDTH, HEIGHT)
    rows, columns, gaussian = np.nonzero(np.asarray(output.features))
    centres, radii = np.asarray(output.means2d), np.asarray(output.radii)
    reach = np.maximum(abs(columns + 0.5 - centres[gaussian, 0]), abs(rows + 0.5 - centres[gaussian, 1]))
    assert np.all(reach <= radii[gaussian])
    assert np.all(radii[::5] == 0)
    assert np.max(reach / radii[gaussian]) > 0.9


def test_probe_moves_the_centres():
    arrays = scene(2)
    probe = jnp.full((40, 2), 0.25)
    probed = rasterize(*arrays, WIDTH, HEIGHT, means2d_probe=probe, pair_capacity=CAPACITY)
    # A moved principal point also moves the clamp of the Jacobian, which no Gaussian of this scene meets.
    shifted, _ = fast(*arrays[:6], arrays[6].at[:2, 2].add(0.25))
    assert_close((probed.features, probed.alpha, probed.depth), shifted)


@pytest.mark.parametrize("form", [None, ACCELERATOR])
def test_overflow_is_reported(form):
    with use_kernels(form):
        check_overflow(scene(3))


def check_overflow(arrays):
    small = rasterize(*arrays, WIDTH, HEIGHT, pair_capacity=50)
    needed = int(small.pairs)
    assert small.overflow
    assert needed > 50
    enough = rasterize(*arrays, WIDTH, HEIGHT, pair_capacity=needed)
    assert not enough.overflow
    assert_close((enough.features, enough.alpha, enough.depth), fast(*arrays)[0], 1e-14)
    means, *others, viewmat, K = arrays
    behind = rasterize(means - 100 * viewmat[2:3, :3], *others, viewmat, K, WIDTH, HEIGHT, pair_capacity=0)
    assert not behind.overflow
    assert not behind.alpha.any()
    views = rasterize(*stacked((3, 3)), WIDTH, HEIGHT, pair_capacity=needed)
    assert views.overflow
    assert int(views.pairs) == 2 * needed


@pytest.mark.parametrize("transformed", [jax.jit, lambda draw: jax.vmap(draw, axis_size=2)])
def test_under_jit_or_vmap_a_pair_capacity_is_required(transformed):
    arrays = stacked((0, 1))
    with pytest.raises(ValueError, match="pair_capacity under jit or vmap"):
        transformed(lambda *a: rasterize(*a, WIDTH, HEIGHT))(*arrays)
