"""The curve network compared with hand-computed cases and a plain transcription; losses and their gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from l2dgs_jax.preprocess.lowlight import curve_network
from l2dgs_jax.training import optimizer

WIDTH = 3

init = jax.jit(curve_network.init, static_argnums=1)
curves = jax.jit(curve_network.curves)
loss_and_gradients = jax.jit(jax.value_and_grad(curve_network.loss))


def network(seed=0, width=WIDTH):
    """Random parameters in the shapes that `init` makes."""
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(lambda: curve_network.init(jax.random.key(0), width))
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(0.05, 0.25, leaf.shape)), shapes)


def images(*shape, seed=1):
    rng = np.random.default_rng(seed)
    return jnp.asarray(rng.uniform(0.1, 0.9, shape)), jnp.asarray(rng.uniform(0.05, 0.3, shape))


@pytest.mark.parametrize(
    ("lightness", "curves", "expected"),
    [
        (0.5, [], 0.5),
        (0.5, [0.5], 0.375),
        (0.5, [0.5, -1.0], 0.609375),
        (0.9, [1.0] * 4, 0.9**16),
        (0.8, [1.0, 1.0], 0.4096),
        (0.2, [-1.0], 0.36),
        (0.3, [0.0] * 10, 0.3),
        (0.0, [0.7] * 10, 0.0),
        (1.0, [0.7] * 10, 1.0),
    ],
)
def test_curves_match_values_computed_by_hand(lightness, curves, expected):
    result = curve_network.iterate(jnp.asarray(lightness), jnp.asarray(curves, float))
    np.testing.assert_allclose(result, expected, rtol=1e-12, atol=0)


def test_curves_stay_in_range_and_darken_or_brighten_by_their_sign():
    rng = np.random.default_rng(0)
    lightness, curves = rng.uniform(0, 1, 500), rng.uniform(-1, 1, (500, 10))
    mixed = curve_network.iterate(jnp.asarray(lightness), jnp.asarray(curves))
    assert np.all((mixed >= 0) & (mixed <= 1))
    assert np.all(curve_network.iterate(jnp.asarray(lightness), jnp.asarray(np.abs(curves))) <= lightness)
    assert np.all(curve_network.iterate(jnp.asarray(lightness), jnp.asarray(-np.abs(curves))) >= lightness)


def test_a_network_of_zeros_gives_its_last_bias():
    zeros = jax.tree.map(jnp.zeros_like, network())
    bias = jnp.arctanh(jnp.linspace(-0.9, 0.9, 10))
    net = zeros._replace(image=(*zeros.image[:6], zeros.image[6]._replace(bias=bias)))
    lightness, exposure = images(4, 5)
    np.testing.assert_allclose(
        curves(net, lightness, exposure), np.broadcast_to(np.linspace(-0.9, 0.9, 10), (4, 5, 10)), rtol=1e-12
    )


def test_one_path_through_the_network_matches_a_formula():
    """Middle taps of single channels carry 2 x and 3 e to the first curve: tanh(2 x - 3 e) where both are positive."""
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape), network())
    for layer in zeros.exposure + zeros.image[:4]:
        layer.weight[1, 1, 0, 0] = 1
    zeros.image[0].weight[1, 1, 0, 0] = 2
    zeros.exposure[0].weight[1, 1, 0, 0] = 3
    zeros.image[6].weight[1, 1, WIDTH, 0] = 1  # its inputs: exposure layer 2, image layers 1 and 6
    zeros.image[6].weight[1, 1, 0, 0] = -1
    lightness, exposure = images(4, 5)
    result = curves(jax.tree.map(jnp.asarray, zeros), lightness, exposure)
    np.testing.assert_allclose(result[..., 0], np.tanh(2 * lightness - 3 * exposure), rtol=1e-12)
    np.testing.assert_array_equal(result[..., 1:], 0)


def plain(net, lightness, exposure):
    """The network as LEDNet's ConditionZeroDCE states it, with loops over the kernel."""

    def conv(layer, x):
        padded = np.pad(x, ((1, 1), (1, 1), (0, 0)))
        taps = [(i, j) for i in range(3) for j in range(3)]
        height, width = x.shape[:2]
        return np.asarray(layer.bias) + sum(
            padded[i : i + height, j : j + width] @ np.asarray(layer.weight[i, j]) for i, j in taps
        )

    relu = lambda x: np.maximum(x, 0)
    e1 = relu(conv(net.exposure[0], np.asarray(exposure)[..., None]))
    e2 = relu(conv(net.exposure[1], e1))
    e3 = relu(conv(net.exposure[2], e2))
    e4 = relu(conv(net.exposure[3], e3))
    x1 = relu(conv(net.image[0], np.asarray(lightness)[..., None]))
    x2 = relu(conv(net.image[1], x1))
    x3 = relu(conv(net.image[2], x2))
    x4 = relu(conv(net.image[3], x3))
    x5 = relu(conv(net.image[4], np.concatenate([e4, x3, x4], -1)))
    x6 = relu(conv(net.image[5], np.concatenate([e3, x2, x5], -1)))
    return np.tanh(conv(net.image[6], np.concatenate([e2, x1, x6], -1)))


def test_network_matches_a_plain_transcription_image_by_image():
    net, (lightness, exposure) = network(), images(2, 8, 8)
    batch = curves(net, lightness, exposure)
    for x, e, expected in zip(lightness, exposure, batch, strict=True):
        np.testing.assert_allclose(plain(net, x, e), expected, rtol=1e-11)


def test_released_width_has_the_released_number_of_parameters():
    shapes = jax.eval_shape(lambda: curve_network.init(jax.random.key(0), 256))
    assert sum(leaf.size for leaf in jax.tree.leaves(shapes)) == 7_154_186


def test_losses_match_values_computed_by_hand():
    ones = jnp.ones((1, 8, 8))
    np.testing.assert_allclose(curve_network.exposure_loss(0.2 * ones, 0.5 * ones), 0.3)
    both = jnp.concatenate([0.2 * ones, 0.6 * ones])
    np.testing.assert_allclose(curve_network.exposure_loss(both, jnp.full((2, 8, 8), 0.5)), 0.2)
    # Halves of 0.8 and 0.4, scaled to a mean of 0.3, are 0.4 and 0.2: halves of 0.5 and 0.1 step 0.2 more.
    halves = lambda left, right: jnp.concatenate([left * ones[..., :4], right * ones[..., 4:]], -1)
    np.testing.assert_allclose(curve_network.spatial_loss(halves(0.5, 0.1), halves(0.8, 0.4)), 2 * 0.2**2)
    np.testing.assert_allclose(curve_network.spatial_loss(halves(0.4, 0.2), halves(0.8, 0.4)), 0, atol=1e-30)
    # One step of 1 in one of two curves: 4 of 12 horizontal differences, none of 12 vertical ones.
    ramp = jnp.zeros((1, 4, 4, 2)).at[:, :, 2:, 0].set(1.0)
    np.testing.assert_allclose(curve_network.smoothness_loss(ramp), 2 * 2 * 4 / (12 * 2))


def test_training_lowers_the_loss():
    batch = images(2, 8, 8)
    start = init(jax.random.key(0), WIDTH)
    rate = optimizer.Schedule(*(jnp.array(value) for value in (5e-3, 5e-3, 1.0)))
    steps = list(curve_network.train(start, [batch] * 20, rate))
    losses = [float(value) for _, value in steps]
    np.testing.assert_allclose(losses[0], loss_and_gradients(start, *batch)[0])
    assert losses[-1] < 0.7 * losses[0]
    assert loss_and_gradients(steps[-1][0], *batch)[0] < losses[-1]


def test_gradients_of_the_objective_through_the_network():
    batch, net = images(2, 8, 8), network()
    _, gradients = loss_and_gradients(net, *batch)
    direction = network(seed=2)
    shifted = lambda step: loss_and_gradients(jax.tree.map(lambda a, b: a + step * b, net, direction), *batch)[0]
    expected = (shifted(1e-5) - shifted(-1e-5)) / 2e-5
    pairs = zip(jax.tree.leaves(gradients), jax.tree.leaves(direction), strict=True)
    np.testing.assert_allclose(sum(np.vdot(a, b) for a, b in pairs), expected, rtol=1e-6)


def test_black_images_have_finite_gradients():
    black = jnp.zeros((2, 8, 8))
    _, gradients = loss_and_gradients(network(), black, black + 0.1)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))
