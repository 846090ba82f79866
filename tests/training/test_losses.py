import dataclasses
import itertools
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from l2dgs_jax.config import LossConfig
from l2dgs_jax.training import losses
from l2dgs_jax.types import Decomposition, RenderOutput

V, H, W = 2, 7, 9
EPS = math.exp(-5)
EVERY_TERM = LossConfig(illumination_tv=0.3, exponent_prior=0.2, exposure_window=3)
AUTHORS = LossConfig(
    l1_on="tonemapped",
    eps=1e-5,
    exposure=1.0,
    exposure_form="squared",
    exposure_of="welllit",
    structure_gradient="magnitude",
    depth_gradient="sobel",
    depth_gain=5.0,
)
value_and_grad = partial(jax.jit, static_argnames=("cfg", "exponent_target"))(
    jax.value_and_grad(losses.total, has_aux=True, allow_int=True)
)


def uniform(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).uniform(size=shape))


def make_render(height=H, width=W, seed=0, views=V, dtype=jnp.float64):
    def draw(i, *channels):
        return uniform(seed + i, views, height, width, *channels).astype(dtype)

    images = Decomposition(draw(1, 3), draw(2, 3), draw(3), draw(4, 3), 1 + 9 * draw(5, 2))
    return RenderOutput(
        images, draw(6), 3 * draw(7), jnp.zeros((views, 4), dtype), jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    )


def constant_render(value, height, width, dtype):
    render = make_render(height, width, views=1, dtype=dtype)
    images = jax.tree.map(lambda x: jnp.full_like(x, value), render.images)
    images = images._replace(attenuation=jnp.full_like(images.attenuation, 1 + 9 * value))
    return render._replace(images=images, depth=jnp.full_like(render.depth, value))


def grads_agree(function, *arguments, modes=("fwd", "rev")):
    check_grads(jax.jit(function), arguments, order=1, modes=modes, eps=1e-6, atol=1e-6, rtol=1e-5)


# Plain transcriptions of the equations, each a loop over pixels.


def pixels(height=H, width=W):
    return itertools.product(range(V), range(height), range(width))


def at(image, v, y, x):
    """A pixel, or zeros outside the image."""
    inside = 0 <= y < image.shape[1] and 0 <= x < image.shape[2]
    return image[v, y, x] if inside else np.zeros_like(image[v, 0, 0])


def forward_pairs(image):
    """Lists of I(x+1) - I(x) and of I(y+1) - I(y)."""
    in_x = [image[v, y, x + 1] - image[v, y, x] for v, y, x in pixels(width=W - 1)]
    in_y = [image[v, y + 1, x] - image[v, y, x] for v, y, x in pixels(height=H - 1)]
    return in_x, in_y


def sobel_pairs(image):
    in_x, in_y = [], []
    for v, y, x in pixels():
        in_x.append(sum(w * (at(image, v, y + k, x + 1) - at(image, v, y + k, x - 1)) for k, w in SMOOTH))
        in_y.append(sum(w * (at(image, v, y + 1, x + k) - at(image, v, y - 1, x + k)) for k, w in SMOOTH))
    return in_x, in_y


SMOOTH = ((-1, 1), (0, 2), (1, 1))


def expected_l1(prediction, target, on, eta, eps):
    total = 0.0
    for index in np.ndindex(prediction.shape):
        a, b = prediction[index], target[index]
        if on == "tonemapped":
            a, b = (a + eps) ** eta, (b + eps) ** eta
        total += abs(a - b)
    return total / prediction.size


def expected_ssim(a, b):
    offsets = range(-5, 6)
    window = {k: math.exp(-(k**2) / (2 * 1.5**2)) for k in offsets}
    norm = sum(window.values()) ** 2
    similarities = []
    for v, y, x in pixels():
        moments = np.zeros((5, a.shape[-1]))
        for j, i in itertools.product(offsets, offsets):
            p, q = at(a, v, y + j, x + i), at(b, v, y + j, x + i)
            moments += window[j] * window[i] / norm * np.stack([p, q, p * p, q * q, p * q])
        ma, mb, aa, bb, ab = moments
        c1, c2 = 0.01**2, 0.03**2
        cov, var_a, var_b = ab - ma * mb, aa - ma**2, bb - mb**2
        similarities.append((2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (var_a + var_b + c2)))
    return 1 - np.mean(similarities)


def expected_exposure(image, level, window, form):
    distances = []
    for v in range(V):
        if window is None or window > min(H, W):
            blocks = [image[v]]
        else:
            corners = itertools.product(range(H // window), range(W // window))
            blocks = [image[v, r * window : (r + 1) * window, c * window : (c + 1) * window] for r, c in corners]
        distances += [np.mean(block) - level for block in blocks]
    return np.mean(np.abs(distances) if form == "absolute" else np.square(distances))


def expected_depth(depth, image, gradient):
    pairs = forward_pairs if gradient == "forward" else sobel_pairs
    axes = zip(pairs(depth), pairs(image), strict=True)
    return sum(np.mean([abs(d) * math.exp(-np.mean(np.abs(i))) for d, i in zip(*axis, strict=True)]) for axis in axes)


def expected_structure(exponent, guide, beta, gradient):
    if gradient == "components":
        axes = zip(forward_pairs(exponent), forward_pairs(guide), strict=True)
        return sum(np.mean([np.abs(beta * b - g) for b, g in zip(*axis, strict=True)]) for axis in axes)

    def magnitude(image, v, y, x):
        dx = at(image, v, y, x + 1) - at(image, v, y, x - 1)
        dy = at(image, v, y + 1, x) - at(image, v, y - 1, x)
        return np.sqrt(dx**2 + dy**2 + 1e-6)

    return np.mean([np.abs(beta * magnitude(exponent, *p) - magnitude(guide, *p)) for p in pixels()])


def close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("on", ["raw", "tonemapped"])
def test_l1_is_the_first_term_of_eq_10(on):
    a, b = uniform(0, V, H, W, 3), uniform(1, V, H, W, 3)
    close(losses.photometric_l1(a, b, on, 0.7, EPS), expected_l1(np.asarray(a), np.asarray(b), on, 0.7, EPS))
    grads_agree(lambda a: losses.photometric_l1(a, b, on, 0.7, EPS), a)


def test_ssim_is_the_second_term_of_eq_10():
    a, b = uniform(0, V, H, W, 3), uniform(1, V, H, W, 3)
    tone_a, tone_b = ((np.asarray(x) + EPS) ** 0.7 for x in (a, b))
    close(losses.photometric_ssim(a, b, 0.7, EPS), expected_ssim(tone_a, tone_b))
    grads_agree(lambda a: losses.photometric_ssim(a, b, 0.7, EPS), a, modes=("rev",))


@pytest.mark.parametrize("window", [3, 4, 16, None])
@pytest.mark.parametrize("form", ["absolute", "squared"])
def test_exposure_is_eq_11(window, form):
    image = uniform(2, V, H, W, 3)
    close(losses.exposure(image, 0.6, window, form), expected_exposure(np.asarray(image), 0.6, window, form))
    grads_agree(lambda image: losses.exposure(image, 0.6, window, form), image)


@pytest.mark.parametrize("window", [3, None])
def test_exposure_is_that_of_valid_pixels(window):
    image, valid = uniform(2, V, H, W, 3), uniform(3, V, H, W) < 0.6
    filled = jnp.where(valid[..., None], image, 0.6)
    masked = lambda image: losses.exposure(image, 0.6, window, "squared", valid)
    close(masked(image), expected_exposure(np.asarray(filled), 0.6, window, "squared"))
    assert jnp.all((jax.grad(masked)(image) != 0).any(-1) <= valid)
    grads_agree(masked, image)


def test_exposure_leaves_out_incomplete_blocks():
    image = jnp.full((V, H, W, 3), 0.6).at[:, 6:].set(1.0)
    assert losses.exposure(image, 0.6, 3, "absolute") < 1e-12 < losses.exposure(image, 0.6, None, "absolute")


@pytest.mark.parametrize("gradient", ["forward", "sobel"])
def test_depth_smoothness_is_eq_12(gradient):
    depth, image = uniform(3, V, H, W), uniform(4, V, H, W, 3)
    close(
        losses.depth_smoothness(depth, image, gradient),
        expected_depth(np.asarray(depth), np.asarray(image), gradient),
    )
    grads_agree(lambda d, i: losses.depth_smoothness(d, i, gradient), depth, image)


def test_amplification_is_eq_13():
    illumination = uniform(5, V, H, W)
    close(losses.amplification(illumination), np.mean([abs(1 - value) for value in np.ravel(illumination)]))
    grads_agree(losses.amplification, illumination)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("gradient", ["components", "magnitude"])
def test_structure_is_eq_14(gradient, channels):
    exponent, guide = 1 + 9 * uniform(6, V, H, W, 1), uniform(7, V, H, W, channels)
    close(
        losses.structure(exponent, guide, 0.5, gradient),
        expected_structure(np.asarray(exponent), np.asarray(guide), 0.5, gradient),
    )
    grads_agree(lambda b, g: losses.structure(b, g, 0.5, gradient), exponent, guide)


def test_total_variation_is_the_mean_step_in_x_plus_the_mean_step_in_y():
    image = uniform(8, V, H, W)
    close(losses.total_variation(image), sum(np.mean(np.abs(steps)) for steps in forward_pairs(np.asarray(image))))
    grads_agree(losses.total_variation, image)


def test_the_exponent_prior_concerns_the_first_exponent_only():
    attenuation = 1 + 9 * uniform(9, V, H, W, 2)
    b1 = np.ravel(attenuation[..., 0])
    close(losses.exponent_prior(attenuation, 1.2), np.mean([abs(b - 1.2) for b in b1]))
    grads_agree(lambda a: losses.exponent_prior(a, 1.2), attenuation)
    assert not jax.grad(losses.exponent_prior)(attenuation, 1.2)[..., 1].any()


def test_eta_decays_exponentially_and_then_stays_constant():
    cfg = LossConfig(eta_start=0.9, eta_end=0.4)
    for step, expected in ((0, 0.9), (50, 0.6), (100, 0.4), (150, 0.4)):
        close(losses.eta(step, 100, cfg), expected)
        np.testing.assert_allclose(losses.eta(jnp.asarray(step, jnp.int32), 100, cfg), expected, rtol=1e-6)
    assert jnp.isfinite(losses.eta(0, 0, cfg))


@pytest.mark.parametrize("cfg", [EVERY_TERM, AUTHORS], ids=["every term", "authors"])
def test_total_is_eq_15(cfg):
    render, target, eta = make_render(), uniform(20, V, H, W, 3), 0.8
    (value, terms), _ = value_and_grad(render, target, cfg, eta, exponent_target=1.2)
    images = jax.tree.map(np.asarray, render.images)
    target = np.asarray(target)
    exposed = images.reflectance if cfg.exposure_of == "reflectance" else images.welllit
    tonemapped = [(image + cfg.eps) ** eta for image in (images.lowlight, target)]
    b1, b2 = images.attenuation[..., :1], images.attenuation[..., 1:]
    form = cfg.structure_gradient
    expected = {
        "l1": (1.0, expected_l1(images.lowlight, target, cfg.l1_on, eta, cfg.eps)),
        "ssim": (1.0, expected_ssim(*tonemapped)),
        "exposure": (
            cfg.exposure,
            expected_exposure(exposed, cfg.exposure_level, cfg.exposure_window, cfg.exposure_form),
        ),
        "amplification": (cfg.amplification, np.mean(np.abs(1 - images.illumination))),
        "structure_reflectance": (1.0, expected_structure(b1, images.reflectance, 0.5, form)),
        "structure_illumination": (1.0, expected_structure(b2, images.illumination[..., None], 0.5, form)),
        "depth": (
            cfg.depth,
            expected_depth(cfg.depth_gain * np.asarray(render.depth), images.welllit, cfg.depth_gradient),
        ),
    }
    if cfg is EVERY_TERM:
        steps = forward_pairs(images.illumination)
        expected["illumination_tv"] = (0.3, sum(np.mean(np.abs(s)) for s in steps))
        expected["exponent_prior"] = (0.2, np.mean(np.abs(b1 - 1.2)))
    assert terms.keys() == expected.keys()
    for name, (_, term) in expected.items():
        close(terms[name], term)
    close(value, sum(weight * term for weight, term in expected.values()))


def test_the_structure_terms_have_their_own_weights_and_scales():
    render, target = make_render(), uniform(20, V, H, W, 3)
    images = jax.tree.map(np.asarray, render.images)
    cfg = LossConfig(structure=0.3, structure_illumination=2.0, structure_beta=0.2, structure_beta_illumination=0.7)
    structure_only = dataclasses.replace(cfg, ssim=0.0, exposure=0.0, amplification=0.0, depth=0.0)
    value, terms = losses.total(render, target, structure_only, 0.8)
    b1, b2 = images.attenuation[..., :1], images.attenuation[..., 1:]
    close(terms["structure_reflectance"], expected_structure(b1, images.reflectance, 0.2, "components"))
    close(terms["structure_illumination"], expected_structure(b2, images.illumination[..., None], 0.7, "components"))
    close(value, terms["l1"] + 0.3 * terms["structure_reflectance"] + 2.0 * terms["structure_illumination"])


def test_reflectance_amplification_is_the_mean_distance_to_one():
    render, target = make_render(), uniform(20, V, H, W, 3)
    plain, _ = losses.total(render, target, LossConfig(), 0.8)
    value, terms = losses.total(render, target, LossConfig(reflectance_amplification=0.05), 0.8)
    close(terms["reflectance_amplification"], np.mean(1 - np.asarray(render.images.reflectance)))
    close(value, plain + 0.05 * terms["reflectance_amplification"])


def test_terms_of_weight_zero_are_not_computed():
    off = dataclasses.replace(LossConfig(), ssim=0.0, exposure=0.0, amplification=0.0, structure=0.0, depth=0.0)
    render = make_render()
    render = render._replace(depth=jnp.full_like(render.depth, jnp.nan))
    value, terms = losses.total(render, uniform(20, V, H, W, 3), off, 0.8)
    assert terms.keys() == {"l1"}
    close(value, terms["l1"])


@pytest.mark.parametrize("cfg", [EVERY_TERM, AUTHORS], ids=["every term", "authors"])
def test_gradients_of_the_total(cfg):
    render, target = make_render(), uniform(20, V, H, W, 3)

    def objective(images, depth):
        return losses.total(render._replace(images=images, depth=depth), target, cfg, 0.8, 1.2)[0]

    grads_agree(objective, render.images, render.depth, modes=("rev",))


@pytest.mark.parametrize("cfg", [EVERY_TERM, AUTHORS], ids=["every term", "authors"])
@pytest.mark.parametrize("size", [(1, 1), (1, 6), (5, 4)], ids=str)
def test_extremes_are_finite_in_single_precision(cfg, size):
    dtype = jnp.float32
    for level, eta, target_level in itertools.product((0.0, 1.0), (0.95, 0.5), (0.0, 1.0)):
        render = constant_render(level, *size, dtype)
        target = jnp.full((1, *size, 3), target_level, dtype)
        (value, _), grad = value_and_grad(render, target, cfg, eta)
        assert value.dtype == dtype
        assert jnp.isfinite(value)
        assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves((grad.images, grad.depth)))


def test_a_black_frame_with_no_offset_is_finite():
    black = jnp.zeros((1, 4, 4, 3))
    objective = jax.jit(jax.value_and_grad(lambda a: losses.photometric_ssim(a, black, 0.5, 0.0)))
    value, grad = objective(black)
    close(value, 0.0)
    assert jnp.isfinite(grad).all()


def test_a_single_pixel_has_no_gradients_to_compare():
    exponent, guide = uniform(1, 1, 1, 1, 1), uniform(2, 1, 1, 1, 3)
    assert losses.total_variation(exponent[..., 0]) == 0
    assert losses.structure(exponent, guide, 0.5, "components") == 0
    assert losses.depth_smoothness(exponent[..., 0], guide, "forward") == 0


def test_the_total_is_the_mean_over_views():
    render, target = make_render(), uniform(20, V, H, W, 3)
    (both, _), _ = value_and_grad(render, target, EVERY_TERM, 0.8)

    def total_of_view(v):
        view = jax.tree.map(lambda x: x[v : v + 1] if x.ndim else x, render)
        (value, _), _ = value_and_grad(view, target[v : v + 1], EVERY_TERM, 0.8)
        return value

    close(both, (total_of_view(0) + total_of_view(1)) / 2)
