import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from l2dgs_jax import metrics

REFERENCE = {
    "gaussian_weights": True,
    "sigma": 1.5,
    "use_sample_covariance": False,
    "channel_axis": -1,
    "data_range": 1,
}
ssim, psnr = jax.jit(metrics.ssim), jax.jit(metrics.psnr)
ssim_map = jax.jit(metrics.ssim_map, static_argnames="border")
ssim_and_gradient = jax.jit(jax.value_and_grad(metrics.ssim))


def pair(seed, *shape):
    rng = np.random.default_rng(seed)
    a = rng.uniform(size=shape)
    return a, np.clip(a + rng.normal(0, 0.1, shape), 0, 1)


def frames(seed=0, count=3, height=14, width=17):
    rng = np.random.default_rng(seed)
    for i in range(count):
        prediction, truth = pair(10 * seed + i, height, width, 3)
        yield prediction, truth, rng.uniform(size=(height, width)) > 0.6


@pytest.mark.parametrize("shape", [(11, 11, 3), (23, 17, 3), (12, 31, 1)], ids=str)
def test_ssim_matches_scikit_image(shape):
    a, b = pair(0, *shape)
    mean, full = structural_similarity(a, b, full=True, **REFERENCE)
    np.testing.assert_allclose(ssim(jnp.asarray(a), jnp.asarray(b)), mean, atol=1e-12)
    np.testing.assert_allclose(ssim_map(jnp.asarray(a), jnp.asarray(b), "mirror"), full, atol=1e-12)


def test_ssim_of_float32_images_keeps_five_digits():
    a, b = pair(1, 40, 50, 3)
    single = ssim(jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32))
    np.testing.assert_allclose(single, structural_similarity(a, b, **REFERENCE), atol=1e-5)


def test_the_border_matters_only_near_the_border():
    a, b = (jnp.asarray(x) for x in pair(2, 16, 18, 3))
    zero, mirror = ssim_map(a, b, "zero"), ssim_map(a, b, "mirror")
    np.testing.assert_allclose(zero[5:-5, 5:-5], mirror[5:-5, 5:-5], atol=1e-13)
    assert jnp.abs(zero - mirror)[0].max() > 1e-3


@pytest.mark.parametrize("border", ["zero", "mirror"])
def test_ssim_of_equal_images_is_one_and_stationary(border):
    a = jnp.asarray(pair(3, 12, 13, 3)[0])
    np.testing.assert_allclose(ssim_map(a, a, border), 1, atol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.grad(lambda b: ssim_map(a, b, border).mean()))(a), 0, atol=1e-10)


def test_ssim_is_symmetric_and_lower_for_worse_images():
    a, b = (jnp.asarray(x) for x in pair(4, 16, 16, 3))
    np.testing.assert_allclose(ssim(a, b), ssim(b, a), atol=1e-13)
    assert ssim(a, b) > ssim(a, b[::-1])


@pytest.mark.parametrize("border", ["zero", "mirror"])
def test_ssim_gradients(border):
    a, b = (jnp.asarray(x) for x in pair(5, 6, 7, 2))
    check_grads(jax.jit(lambda a, b: ssim_map(a, b, border).mean()), (a, b), 1, ("rev",), 1e-6, 1e-6, eps=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (1, 20), (4, 10), (10, 11)], ids=str)
def test_images_smaller_than_the_window_have_a_finite_ssim(size):
    a, b = (jnp.asarray(x) for x in pair(6, *size, 3))
    value, grad = ssim_and_gradient(a, b)
    assert -1 <= value < 1
    assert jnp.isfinite(grad).all()
    np.testing.assert_allclose(ssim(a, a), 1, atol=1e-12)


@pytest.mark.parametrize("level", [0.0, 1.0])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_flat_images_have_finite_ssim(level, dtype):
    flat = jnp.full((12, 12, 3), level, dtype)
    for other in (flat, 1 - flat):
        value, grad = ssim_and_gradient(flat, other)
        assert jnp.isfinite(value)
        assert jnp.isfinite(grad).all()


def test_batches_are_scored_image_by_image():
    a, b = (jnp.asarray(x) for x in pair(7, 2, 3, 12, 13, 3))
    mask = jnp.asarray(np.random.default_rng(0).uniform(size=(2, 3, 12, 13)) > 0.5)
    for together, one in (
        (ssim(a, b), ssim(a[1, 2], b[1, 2])),
        (psnr(a, b), psnr(a[1, 2], b[1, 2])),
        (psnr(a, b, mask), psnr(a[1, 2], b[1, 2], mask[1, 2])),
    ):
        assert together.shape == (2, 3)
        np.testing.assert_allclose(together[1, 2], one, rtol=1e-12)


def test_psnr_matches_scikit_image():
    a, b = pair(8, 9, 10, 3)
    expected = peak_signal_noise_ratio(a, b, data_range=1)
    np.testing.assert_allclose(psnr(jnp.asarray(a), jnp.asarray(b)), expected, rtol=1e-12)
    everywhere = jnp.ones((9, 10), bool)
    np.testing.assert_allclose(psnr(jnp.asarray(a), jnp.asarray(b), everywhere), expected, rtol=1e-12)
    assert psnr(jnp.asarray(a), jnp.asarray(a)) == jnp.inf


def test_masked_psnr_depends_on_the_mask_only():
    a, b = pair(9, 12, 13, 3)
    mask = np.zeros((12, 13), bool)
    mask[3:7, 2:9] = True
    expected = peak_signal_noise_ratio(a[3:7, 2:9], b[3:7, 2:9], data_range=1)
    np.testing.assert_allclose(psnr(jnp.asarray(a), jnp.asarray(b), jnp.asarray(mask)), expected, rtol=1e-12)


def test_empty_masks_have_no_psnr():
    a = jnp.asarray(pair(10, 12, 12, 3)[0])
    empty = jnp.zeros((12, 12), bool)
    assert jnp.isnan(psnr(a, a, empty))


REGIONS = {"overall": np.ones_like, "dynamic": np.asarray, "static": np.logical_not}


def test_summary_is_the_mean_over_frames():
    split = list(frames())
    summary = metrics.summarise([metrics.compare(*frame) for frame in split])
    assert summary.keys() == REGIONS.keys()
    for region, choose in REGIONS.items():
        psnrs = [peak_signal_noise_ratio(t[choose(mask)], p[choose(mask)], data_range=1) for p, t, mask in split]
        np.testing.assert_allclose(summary[region]["psnr"], np.mean(psnrs), rtol=1e-12)
    ssims = [structural_similarity(p, t, **REFERENCE) for p, t, _ in split]
    np.testing.assert_allclose(summary["overall"]["ssim"], np.mean(ssims), atol=1e-12)
    assert json.loads(json.dumps(summary)) == summary


def test_regions_without_pixels_are_left_out():
    prediction, truth, mask = next(frames())
    nothing_moves = metrics.compare(prediction, truth, np.zeros_like(mask))
    assert nothing_moves.keys() == {"overall", "static"}
    assert metrics.compare(prediction, truth).keys() == {"overall"}
    something_moves = metrics.compare(prediction, truth, mask)
    summary = metrics.summarise([nothing_moves, something_moves])
    np.testing.assert_allclose(summary["dynamic"]["psnr"], something_moves["dynamic"]["psnr"])


def test_mixed_precision_frames_are_accepted():
    prediction, truth, mask = next(frames())
    single = metrics.compare(jnp.asarray(prediction, jnp.float32), truth, jnp.asarray(mask))
    double = metrics.compare(prediction, truth, mask)
    np.testing.assert_allclose(single["dynamic"]["psnr"], double["dynamic"]["psnr"], atol=1e-4)


def partial_ssim_by_windows(a, b, mask):
    """DyCheck's mSSIM (arXiv 2210.13445), computed window by window."""
    window = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window /= window.sum()

    def along_a_line(values, seen):
        return 11 * (window * values * seen).sum() / seen.sum() if seen.any() else 0.0

    def mean(values):
        rows, columns = values.shape
        lines = np.array(
            [
                [along_a_line(values[i, j : j + 11], mask[i, j : j + 11]) for j in range(columns - 10)]
                for i in range(rows)
            ]
        )
        seen = np.array([[mask[i, j : j + 11].any() for j in range(columns - 10)] for i in range(rows)])
        return np.array(
            [
                [along_a_line(lines[i : i + 11, j], seen[i : i + 11, j]) for j in range(columns - 10)]
                for i in range(rows - 10)
            ]
        )

    scores = []
    for x, y in zip(np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0), strict=True):
        ux, uy = mean(x), mean(y)
        vx, vy = np.maximum(mean(x * x) - ux**2, 0), np.maximum(mean(y * y) - uy**2, 0)
        cov = mean(x * y) - ux * uy
        cov = np.sign(cov) * np.minimum(np.sqrt(vx * vy), np.abs(cov))
        scores.append((2 * ux * uy + 1e-4) * (2 * cov + 9e-4) / ((ux**2 + uy**2 + 1e-4) * (vx + vy + 9e-4)))
    return np.mean(scores)


@pytest.mark.parametrize("share", [1.0, 0.7, 0.03])
def test_partial_ssim_matches_dycheck(share):
    a, b = pair(11, 15, 17, 3)
    mask = np.random.default_rng(0).random((15, 17)) < share
    actual = metrics.partial_ssim(jnp.asarray(a), jnp.asarray(b), jnp.asarray(mask))
    np.testing.assert_allclose(actual, partial_ssim_by_windows(a, b, mask), atol=1e-12)
    if share == 1:
        np.testing.assert_allclose(actual, ssim(jnp.asarray(a), jnp.asarray(b)), atol=1e-12)


def test_invalid_pixels_change_no_score():
    prediction, truth, moving = next(frames())
    valid = np.random.default_rng(1).random(moving.shape) < 0.8
    covisible = np.random.default_rng(2).random(moving.shape) < 0.5
    scores = metrics.compare(prediction, truth, moving, valid, covisible)
    assert scores.keys() == {"overall", "dynamic", "static", "covisible"}
    other = np.where(valid[..., None], truth, 1 - truth)
    assert metrics.compare(prediction, other, moving, valid, covisible) == scores
    for region, mask in (("overall", valid), ("dynamic", valid & moving), ("covisible", valid & covisible)):
        expected = peak_signal_noise_ratio(truth[mask], prediction[mask], data_range=1)
        np.testing.assert_allclose(scores[region]["psnr"], expected, rtol=1e-12)
    replaced = np.where(valid[..., None], truth, prediction)
    for region, mask in (("overall", valid), ("covisible", valid & covisible)):
        np.testing.assert_allclose(
            scores[region]["ssim"], partial_ssim_by_windows(prediction, replaced, mask), atol=1e-12
        )
    for convention in ("nsff", "paper"):
        nothing = metrics.compare(prediction, truth, moving, np.zeros_like(valid), covisible, convention=convention)
        assert nothing == {}


def test_values_that_are_not_finite_matter_only_where_pixels_are_valid():
    prediction, truth, moving = next(frames())
    valid = np.random.default_rng(1).random(moving.shape) < 0.8
    measures = metrics.BASIC | {"ssim_3dgs": metrics.SSIM_3DGS, "flip": metrics.FLIP}
    scores = metrics.compare(np.where(valid[..., None], prediction, 0), truth, moving, valid, measures=measures)
    for wrong in (np.nan, np.inf):
        spoiled = np.where(valid[..., None], prediction, wrong)
        assert metrics.compare(spoiled, truth, moving, valid, measures=measures) == scores
        spoiled = np.where(valid[..., None], wrong, prediction)
        assert np.isnan(metrics.compare(spoiled, truth, moving, valid)["overall"]["psnr"])


def test_clipped_keeps_infinite_values_apart():
    values = np.float32([-1, 0.25, 2, np.inf, -np.inf, np.nan])
    np.testing.assert_array_equal(metrics.clipped(values), np.float32([0, 0.25, 1, np.nan, np.nan, np.nan]))
    assert metrics.clipped(values).dtype == np.float32


def test_images_and_masks_of_integers_are_refused():
    prediction, truth, moving = next(frames())
    compare = metrics.compare.__wrapped__  # without the type checks that only tests have
    with pytest.raises(ValueError, match="prediction: an image of uint8; expected floating-point values"):
        compare((255 * prediction).astype(np.uint8), truth)
    with pytest.raises(ValueError, match="truth: an image of uint8; expected floating-point values"):
        compare(prediction, (255 * truth).astype(np.uint8))
    with pytest.raises(ValueError, match="dynamic: a mask of uint8; expected booleans"):
        compare(prediction, truth, moving.astype(np.uint8))


def test_regions_of_a_partly_valid_frame_average_windows_of_valid_pixels():
    """If pixels that do not count were set equal instead, windows beside them would score too high."""
    prediction, truth = pair(3, 30, 40, 3)
    moving = np.random.default_rng(4).random((30, 40)) < 0.5
    valid = np.ones((30, 40), bool)
    valid[:, 15:] = False
    found = metrics.compare(prediction, truth, moving, valid)
    alone = metrics.compare(prediction[:, :15], truth[:, :15], moving[:, :15])
    assert found["dynamic"]["ssim"] == pytest.approx(alone["dynamic"]["ssim"], abs=0.02)
