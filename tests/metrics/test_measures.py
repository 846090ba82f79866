"""Measures compared with scikit-image and plain NumPy, and the conventions for regions."""

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from l2dgs_jax import metrics
from l2dgs_jax.metrics import FLIP, MS_SSIM, PSNR, SSIM, SSIM_3DGS, Measure
from l2dgs_jax.metrics.measures import mean_score

WINDOW = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
WINDOW /= WINDOW.sum()
INSIDE = (slice(5, -5), slice(5, -5))


def pair(seed, height, width, noise=0.1):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(size=(height, width, 3))
    return np.clip(truth + rng.normal(0, noise, truth.shape), 0, 1), truth


def random_mask(seed, *shape):
    return np.random.default_rng(seed).random(shape) < 0.4


def score(measure, a, b, mask=None):
    return mean_score(measure.maps(a, b), measure, np.ones(a.shape[:2], bool) if mask is None else mask)


def test_ssim_of_a_region_matches_scikit_image_in_windows_inside_the_image():
    (a, b), mask = pair(0, 21, 26), random_mask(1, 21, 26)
    mean, full = structural_similarity(
        a, b, full=True, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, channel_axis=-1, data_range=1
    )
    np.testing.assert_allclose(score(SSIM, a, b), mean, atol=1e-12)
    np.testing.assert_allclose(score(SSIM, a, b, mask), full[INSIDE][mask[INSIDE]].mean(), atol=1e-12)


@pytest.mark.parametrize("measure", [SSIM, SSIM_3DGS, FLIP], ids=["SSIM", "SSIM of 3DGS", "FLIP"])
def test_means_of_regions_average_to_the_overall_mean(measure):
    (a, b), mask = pair(2, 21, 26), random_mask(3, 21, 26)
    counted = mask[INSIDE] if measure is SSIM else mask
    parts = score(measure, a, b, mask), score(measure, a, b, ~mask)
    np.testing.assert_allclose(np.average(parts, weights=(counted.sum(), (~counted).sum())), score(measure, a, b))


def blurred(image, crop=False):
    """The mean over each pixel's Gaussian window, with zeros beyond the image."""
    padded = np.pad(image, [(5, 5), (5, 5), (0, 0)])
    height, width = image.shape[:2]
    weights = np.outer(WINDOW, WINDOW)
    total = sum(weights[i, j] * padded[i : i + height, j : j + width] for i in range(11) for j in range(11))
    return total[INSIDE] if crop else total


def statistics(a, b, crop):
    mean_a, mean_b = blurred(a, crop), blurred(b, crop)
    return (
        mean_a,
        mean_b,
        blurred(a * a, crop) - mean_a**2,
        blurred(b * b, crop) - mean_b**2,
        blurred(a * b, crop) - mean_a * mean_b,
    )


def test_ssim_of_3dgs_is_computed_with_zeros_beyond_the_image():
    a, b = pair(4, 21, 26)
    u, v, var_u, var_v, cov = statistics(a, b, crop=False)
    similarity = (2 * u * v + 1e-4) * (2 * cov + 9e-4) / ((u**2 + v**2 + 1e-4) * (var_u + var_v + 9e-4))
    np.testing.assert_allclose(score(SSIM_3DGS, a, b), similarity.mean(), atol=1e-12)


def ms_ssim_of_the_paper(a, b):
    """Eq. 7 of Wang, Simoncelli and Bovik (2003) with its five exponents, channel by channel."""
    product = np.ones(3)
    for scale, exponent in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333), start=1):
        u, v, var_u, var_v, cov = statistics(a, b, crop=True)
        luminance = (2 * u * v + 1e-4) / (u**2 + v**2 + 1e-4)
        contrast = (2 * np.sqrt(var_u * var_v) + 9e-4) / (var_u + var_v + 9e-4)
        structure = (cov + 4.5e-4) / (np.sqrt(var_u * var_v) + 4.5e-4)
        local = contrast * structure * (luminance if scale == 5 else 1)
        product *= local.mean((0, 1)) ** exponent
        halves = []
        for image in (a, b):  # a low-pass filter of two by two pixels, then every other pixel
            after = np.pad(image, [(0, 1), (0, 1), (0, 0)], "symmetric")
            halves.append(((after[:-1, :-1] + after[1:, :-1] + after[:-1, 1:] + after[1:, 1:]) / 4)[::2, ::2])
        a, b = halves
    return product.mean()


@pytest.mark.parametrize("shape", [(161, 190), (176, 163)], ids=str)
def test_ms_ssim_matches_its_paper(shape):
    a, b = pair(5, *shape, noise=0.3)
    assert 0.5 < score(MS_SSIM, a, b) < 0.99
    np.testing.assert_allclose(score(MS_SSIM, a, b), ms_ssim_of_the_paper(a, b), rtol=1e-9)
    np.testing.assert_allclose(score(MS_SSIM, b, b), 1, rtol=1e-9)


def test_ms_ssim_of_a_region_is_measured_there_at_every_scale():
    a, b = pair(6, 170, 180, noise=0.3)
    left = np.zeros(a.shape[:2], bool)
    left[:, :90] = True
    better = np.where(left[..., None], b, a)
    assert score(MS_SSIM, better, b, left) > score(MS_SSIM, better, b) > score(MS_SSIM, better, b, ~left)


def test_scores_that_images_are_too_small_for_are_unknown():
    a, b = pair(7, 21, 26)
    border = np.zeros(a.shape[:2], bool)
    border[:5] = True
    scores = metrics.compare(a, b, border, measures=metrics.BASIC | {"ms_ssim": MS_SSIM})
    assert scores["dynamic"]["ssim"] is scores["overall"]["ms_ssim"] is None
    summary = metrics.summarise([scores])
    assert summary["dynamic"]["ssim"] is summary["overall"]["ms_ssim"] is None
    assert summary["dynamic"]["psnr"] == scores["dynamic"]["psnr"]
    for height, known in ((160, False), (161, True)):
        assert np.isfinite(score(MS_SSIM, *pair(7, height, 300))) == known


def test_a_nan_pixel_leaves_no_overall_score():
    a, b = pair(13, 21, 26)
    a[10, 12] = np.nan
    mask = np.zeros((21, 26), bool)
    mask[:, :4] = True
    measures = metrics.BASIC | {"ssim_3dgs": SSIM_3DGS, "flip": FLIP}
    scores = metrics.compare(a, b, mask, measures=measures)
    assert all(np.isnan(scores["overall"][name]) for name in measures)
    assert scores["dynamic"]["psnr"] == pytest.approx(-10 * np.log10(((a - b)[:, :4] ** 2).mean()))
    summary = metrics.summarise([scores, metrics.compare(b, b, mask, measures=measures)])
    assert all(summary["overall"][name] is None for name in measures)


# A measure for which the conventions are simple to compute: the mean difference at a quarter of the size.
COARSE = Measure(
    lambda a, b: [np.abs(a - b).reshape(a.shape[0] // 4, 4, a.shape[1] // 4, 4, 3).mean((1, 3))],
    lambda means: float(means[0].mean()),
    spread=True,
)


def test_the_conventions_differ_in_how_a_region_is_measured():
    a, b = pair(8, 12, 16)
    mask = np.zeros((12, 16), bool)
    mask[2:9, 1:10] = True
    found = {
        convention: metrics.compare(a, b, mask, measures={"psnr": PSNR, "coarse": COARSE}, convention=convention)
        for convention in ("nsff", "masked", "paper")
    }
    blocks = COARSE.maps(a, b)[0]
    assert found["nsff"]["dynamic"]["coarse"] == pytest.approx(blocks[mask[::4, ::4]].mean())
    black = COARSE.maps(a * mask[..., None], b * mask[..., None])[0]
    assert found["masked"]["dynamic"]["coarse"] == pytest.approx(black[mask[::4, ::4]].mean())
    assert found["paper"]["dynamic"]["coarse"] == pytest.approx(mask.mean() * blocks.mean())
    assert found["paper"]["static"]["coarse"] == pytest.approx((~mask).mean() * blocks.mean())
    for scores in found.values():
        assert scores["overall"] == found["nsff"]["overall"]
        assert scores["dynamic"]["psnr"] == pytest.approx(found["nsff"]["dynamic"]["psnr"])
        assert (scores["overall"]["area"], scores["dynamic"]["area"]) == (1, mask.mean())


def test_regions_add_up_to_the_whole_in_the_papers_convention():
    """Also over frames of which some do not show a region, as in the paper's Table 1."""
    (a, b), mask = pair(8, 12, 16), np.arange(16) < np.full((12, 1), 5)
    for masks in ((mask, np.zeros_like(mask)), (mask, np.ones_like(mask))):
        frames = [
            metrics.compare(a + shift, b, one, measures={"psnr": PSNR, "coarse": COARSE}, convention="paper")
            for shift, one in zip((0.0, 0.3), masks, strict=True)
        ]
        found = metrics.summarise(frames)
        parts = found["dynamic"]["coarse"] + found["static"]["coarse"]
        assert parts == pytest.approx(found["overall"]["coarse"])
        assert found["dynamic"]["area"] == np.mean([one.mean() for one in masks if one.any()])


def test_masked_ssim_is_that_of_dycheck_in_every_region():
    (a, b), mask = pair(9, 21, 26), random_mask(10, 21, 26)
    expected = SSIM.masked(a, b, mask)
    assert metrics.compare(a, b, mask, convention="masked")["dynamic"]["ssim"] == pytest.approx(expected)
    assert metrics.compare(a, b, covisible=mask)["covisible"]["ssim"] == pytest.approx(expected)


def test_an_image_equal_to_the_truth_has_the_best_scores():
    _, truth = pair(11, 168, 170)
    measures = metrics.BASIC | {"ssim_3dgs": SSIM_3DGS, "ms_ssim": MS_SSIM, "flip": FLIP}
    scores = metrics.compare(truth, truth, random_mask(12, 168, 170), measures=measures)
    for region in ("overall", "dynamic", "static"):
        assert scores[region]["psnr"] == np.inf
        assert scores[region]["flip"] == 0
        for name in ("ssim", "ssim_3dgs"):
            assert scores[region][name] == pytest.approx(1)
    assert scores["overall"]["ms_ssim"] == pytest.approx(1)
