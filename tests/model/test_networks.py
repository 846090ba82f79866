"""Heads, OCD-Net and BAFE-Net: plain transcriptions, gradients, initial weights and extreme inputs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.config import ModelConfig
from l2dgs_jax.model import networks

CFG = ModelConfig(hidden=6, sh_degree=1, opacity_head=True)
IDENTITY = dataclasses.replace(CFG, identity_start=True)

apply_bafe = jax.jit(networks.apply_bafe)
bafe_value_and_grad = jax.jit(jax.value_and_grad(lambda p, x: networks.apply_bafe(p, x).sum(), (0, 1)))


def size(parameters):
    return sum(leaf.size for leaf in jax.tree.leaves(parameters))


def random_parameters(init, *settings, seed=0):
    """Random parameters in the shapes that `init` makes, biases and scales included."""
    rng = np.random.default_rng(seed)
    shapes = jax.eval_shape(lambda: init(jax.random.key(0), *settings))
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(0.1, 0.4, leaf.shape)), shapes)


def noise(*shape, seed=5):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def test_parameter_counts_are_those_of_the_released_code():
    full = ModelConfig()
    key = jax.random.key(0)
    assert size(jax.eval_shape(lambda: networks.init_ocd(key, full))) == 18_576
    assert size(jax.eval_shape(lambda: networks.init_bafe(key, None))) == 2_818


def test_weights_are_xavier_uniform_and_biases_zero():
    heads = networks.init_heads(jax.random.key(0), 60, dataclasses.replace(CFG, hidden=60))
    for layer in (heads.aggregate, *heads.mean, *heads.quat, *heads.scale, *heads.opacity):
        limit = np.sqrt(6 / sum(layer.weight.shape))
        assert 0.9 * limit < np.abs(layer.weight).max() <= limit
        np.testing.assert_array_equal(layer.bias, 0)
    conv = networks.init_bafe(jax.random.key(0), None).conv2
    limit = np.sqrt(6 / (9 * 8 + 9 * 16))
    assert 0.9 * limit < np.abs(conv.weight).max() <= limit
    first_layers = [heads.mean[0].weight, heads.quat[0].weight, heads.scale[0].weight]
    assert not np.allclose(first_layers[0], first_layers[1])
    assert not np.allclose(first_layers[1], first_layers[2])


def test_heads_match_a_plain_transcription():
    heads, features = random_parameters(networks.init_heads, 5, CFG), noise(2, 3, 5)
    relu = lambda x: np.maximum(x, 0)
    plain, features = jax.tree.map(np.asarray, (heads, features))
    hidden = features @ plain.aggregate.weight + plain.aggregate.bias
    expected = [hidden]
    for first, last in plain[1:]:
        expected.append(relu(relu(hidden) @ first.weight + first.bias) @ last.weight + last.bias)
    expected[-1] = expected[-1][..., 0]
    hidden, motion = networks.apply_heads(heads, jnp.asarray(features))
    assert [x.shape for x in (hidden, *motion)] == [(2, 3, 6), (2, 3, 3), (2, 3, 4), (2, 3, 3), (2, 3)]
    for a, e in zip((hidden, *motion), expected, strict=True):
        np.testing.assert_allclose(a, e, rtol=1e-12)


def test_ocd_matches_a_plain_transcription():
    ocd, hidden = random_parameters(networks.init_ocd, CFG), noise(7, 6)
    elu = lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0)))
    plain = jax.tree.map(np.asarray, ocd)
    inner = elu(elu(np.asarray(hidden)) @ plain.hidden.weight + plain.hidden.bias)
    expected = np.maximum(inner @ plain.out.weight + plain.out.bias, 0)
    np.testing.assert_allclose(networks.apply_ocd(ocd, hidden), expected, rtol=1e-12)
    assert (expected == 0).any()
    assert (expected > 0).any()


def test_gradients_of_heads_and_ocd():
    heads = random_parameters(networks.init_heads, 5, CFG)
    check_grads(jax.jit(networks.apply_heads), (heads, noise(2, 5)), 1, ["fwd", "rev"])
    ocd = random_parameters(networks.init_ocd, CFG)
    check_grads(jax.jit(networks.apply_ocd), (ocd, noise(3, 6)), 1, ["fwd", "rev"])


def test_identity_start_gives_no_motion_and_factors_of_one_and_can_learn():
    features = noise(4, 5)
    heads, ocd = networks.init_heads(jax.random.key(0), 5, IDENTITY), networks.init_ocd(jax.random.key(1), IDENTITY)
    hidden, motion = networks.apply_heads(heads, features)
    assert np.abs(hidden).max() > 0
    for offset in motion:
        np.testing.assert_array_equal(offset, 0)
    np.testing.assert_array_equal(networks.apply_ocd(ocd, hidden), 1)
    gradients = jax.jit(jax.grad(lambda h: sum(x.sum() for x in jax.tree.leaves(networks.apply_heads(h, features)))))(
        heads
    )
    for _, last in gradients[1:]:
        assert np.all(last.bias != 0)
        assert np.any(last.weight != 0)
    gradient = jax.jit(jax.grad(lambda o: networks.apply_ocd(o, hidden).sum()))(ocd).out
    assert np.all(gradient.bias != 0)
    assert np.all(gradient.weight != 0)


def plain_bafe(bafe, attenuation):
    """BAFE-Net on one image, with loops over the kernel."""

    def conv(layer, x):
        k, (h, w) = len(layer.weight), x.shape[:2]
        padded = np.pad(x, ((k // 2, k // 2), (k // 2, k // 2), (0, 0)))
        y = np.zeros((h, w, layer.bias.size)) + np.asarray(layer.bias)
        for i in range(k):
            for j in range(k):
                y += padded[i : i + h, j : j + w] @ np.asarray(layer.weight[i, j])
        return y

    def norm(layer, x, groups):
        parts = [(p - p.mean()) / np.sqrt(p.var() + 1e-5) for p in np.split(x, groups, axis=-1)]
        return np.concatenate(parts, -1) * np.asarray(layer.scale) + np.asarray(layer.bias)

    leaky = lambda x: np.where(x > 0, x, 0.01 * x)
    first = leaky(norm(bafe.norm1, conv(bafe.conv1, np.tanh(attenuation)), 2))
    second = leaky(norm(bafe.norm2, conv(bafe.conv2, first), 4))
    third = leaky(norm(bafe.norm3, conv(bafe.conv3, second), 2) + 0.3 * first)
    raw = conv(bafe.out, third)
    return 5.5 + 4.5 * raw / (1 + np.abs(raw))


def test_bafe_matches_a_plain_transcription_image_by_image():
    bafe, images = random_parameters(networks.init_bafe, None), noise(2, 7, 9, 2)
    actual = apply_bafe(bafe, images)
    for image, exponents in zip(images, actual, strict=True):
        np.testing.assert_allclose(exponents, plain_bafe(bafe, np.asarray(image)), rtol=1e-9)
    np.testing.assert_allclose(networks.apply_bafe(bafe, images[0]), actual[0], rtol=1e-12)


def test_gradients_of_bafe():
    bafe = random_parameters(networks.init_bafe, None)
    check_grads(apply_bafe, (bafe, noise(2, 4, 5, 2)), 1, ["fwd", "rev"], eps=1e-6)


@pytest.mark.parametrize("exponents", [(1.05, 9.0), (5.5, 5.5), (9.999, 1.001)])
def test_bafe_net_initially_returns_the_initial_exponents(exponents):
    bafe = networks.init_bafe(jax.random.key(0), jnp.asarray(networks.exponent_bias(exponents)))
    np.testing.assert_allclose(apply_bafe(bafe, noise(2, 4, 5, 2)), np.tile(exponents, (2, 4, 5, 1)), rtol=1e-12)
    gradient = bafe_value_and_grad(bafe, noise(4, 5, 2))[1][0]
    assert np.all(gradient.out.weight != 0)
    assert np.all(gradient.out.bias != 0)


def test_without_initial_exponents_the_bias_is_zero_and_the_kernel_random():
    out = networks.init_bafe(jax.random.key(0), None).out
    np.testing.assert_array_equal(out.bias, 0)
    assert np.all(out.weight != 0)


@pytest.mark.parametrize("exponents", [(1.0, 9.0), (2.0, 10.0), (0.0, 5.0), (float("nan"), 5.0), ("auto", 9.0)])
def test_impossible_initial_exponents_are_refused(exponents):
    with pytest.raises(ValueError, match="strictly between 1 and 10"):
        networks.exponent_bias(exponents)


@pytest.mark.parametrize("image", [np.zeros((4, 5, 2)), np.full((4, 5, 2), 1e30), np.ones((1, 1, 2))])
def test_bafe_is_finite_at_extremes(image):
    bafe = random_parameters(networks.init_bafe, None)
    value, gradients = jax.value_and_grad(lambda p, x: networks.apply_bafe(p, x).sum(), (0, 1))(
        bafe, jnp.asarray(image)
    )
    assert 1 * image.size < value < 10 * image.size
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradients))
