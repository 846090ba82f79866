"""Low-light twins of well-lit scenes, with the scenes themselves as ground truth."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float16, Float32, UInt8
from tqdm import tqdm

from l2dgs_jax import metrics
from l2dgs_jax.data.dataset import Dataset, Split
from l2dgs_jax.data.images import to_bytes
from l2dgs_jax.data.stacks import MappedArray, evenly_spread, stacked
from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.lowlight import darkening, weights
from l2dgs_jax.visualize.sheet import sheet

Bytes = UInt8[np.ndarray, "H W 3"]


READ_NOISE = 2.0  # electrons, unless something else is asked for
MAX_ELECTRONS = 1e9
DRIFT_PERIODS = 1.5  # of the wave by which exposure drifts, over the whole video
SAMPLED_PIXELS = 1_000_000  # of a video, that its darkening is fitted to


@dataclass(frozen=True)
class DarkeningConfig:
    """How a scene is darkened.

    Attributes:
        method: "analytic", one curve for the whole video; "network", curves from a network that sees every pixel's
            neighbourhood; or "camera", less light on the sensor.
        weights: file with the network's weights: LEDNet's ce_zerodce.pth or an .npz of
            experiments.makers.train_darkener; if not given, those of this package.
        exposure: mean lightness of the dark frames, not counting saturated pixels; drawn from the range if not given.
        exposure_range: lowest and highest exposure to draw (LEDNet: 0.05 0.3).
        per_image: draw an exposure for every frame, which makes videos flicker, instead of one for all frames.
        exposure_drift: amplitude by which the light that the camera gathers rises and falls over the video, relative
            to its mean; 0 for constant exposure.
        photons: electrons per pixel that white stands for; if given, sensor noise is added, which is stronger for fewer
            electrons.
        read_noise: standard deviation of the sensor's read noise, in electrons; 2 with `photons` if not given.
        lab_order: how lightness is computed: "correct", or "lednet", with red and blue swapped as in LEDNet's script.
        allow_brightening: let pixels become brighter where the network says so, as LEDNet does.
        seed: seed of exposures and noise.
    """

    method: Literal["analytic", "network", "camera"] = "analytic"
    weights: Path | None = None
    exposure: float | None = None
    exposure_range: tuple[float, float] = (0.05, 0.08)
    per_image: bool = False
    exposure_drift: float = 0.0
    photons: float | None = None
    read_noise: float | None = None
    lab_order: darkening.LabOrder = "correct"
    allow_brightening: bool = False
    seed: int = 0

    def check(self) -> None:
        """Check the settings.

        Raises:
            UserError: one of them is invalid.
        """
        low, high = self.exposure_range if self.exposure is None else (self.exposure,) * 2
        if not 0 < low <= high < 1:
            name = "--exposure-range" if self.exposure is None else "--exposure"
            raise UserError(
                f"{name}: is {low:g} ... {high:g}; expected mean lightnesses between 0 (black) and 1 (white)"
            )
        if not 0 <= self.exposure_drift < 1:
            raise UserError(f"--exposure-drift {self.exposure_drift:g}: expected a share from 0, below 1")
        if self.weights is not None and self.method != "network":
            raise UserError("--weights: go with --method network; expected that method, or no weights")
        if self.read_noise is not None and self.photons is None:
            raise UserError("--read-noise: goes with --photons; expected both, or neither")
        if self.photons is not None and not (
            0 < self.photons <= MAX_ELECTRONS and 0 <= (self.read_noise or 0) <= MAX_ELECTRONS
        ):
            raise UserError(
                "--photons and --read-noise: expected electrons, the former more than 0, the latter at least 0, "
                f"both at most {MAX_ELECTRONS:g}"
            )
        if self.seed < 0:
            raise UserError(f"--seed {self.seed}: expected a whole number from 0")


class FrameReport(NamedTuple):
    """How dark a frame became.

    Attributes:
        exposure: the exposure that was asked for.
        light: additional factor on the light of this frame, from the drift of exposure.
        psnr: dB, of the dark frame against the well-lit one; None if they are equal.
        level: mean sRGB value of the dark frame.
        welllit_level: mean sRGB value of the well-lit frame.
    """

    exposure: float
    light: float
    psnr: float | None
    level: float
    welllit_level: float


def darken(dataset: Dataset, cfg: DarkeningConfig) -> tuple[Dataset, dict[str, FrameReport]]:
    """The low-light twin of a scene, whose ground truth are the original pictures, and a report on every frame.

    Colours of points are dropped because they are well-lit.

    Raises:
        UserError: the scene is not brighter than the exposure, or has well-lit pictures of one split only.
    """
    names = dataset.train.names + dataset.test.names
    pictures = [to_bytes(picture) for picture in _sources(dataset)]
    exposures, lights = _exposures(len(names), cfg), _lights(dataset, cfg)
    darkened = _darkened(pictures, _counted(dataset), exposures, dataset.name, cfg)
    frames: dict[str, FrameReport] = {}
    dark: list[Bytes] = []
    for i, name in enumerate(tqdm(names, desc="darken", unit="frame", dynamic_ncols=True)):
        image = _floats(pictures[i])
        low = darkening.scale_light(darkened(i), lights[i])
        if cfg.photons is not None:
            read_noise = READ_NOISE if cfg.read_noise is None else cfg.read_noise
            low = darkening.add_sensor_noise(low, (cfg.seed, i), cfg.photons, read_noise)
        dark.append(darkening.truncate(low))
        low = _floats(dark[i])
        psnr = float(metrics.psnr(jnp.asarray(low), jnp.asarray(image)))
        finite = psnr if math.isfinite(psnr) else None
        frames[name] = FrameReport(exposures[i], lights[i], finite, float(low.mean()), float(image.mean()))

    first = len(dataset.train.names)
    return dataclasses.replace(
        dataset,
        train=_twin(dataset.train, dark[:first], pictures[:first]),
        test=_twin(dataset.test, dark[first:], pictures[first:]),
        colors=None,
    ), frames


def contact_sheet(dataset: Dataset, rows: int = 4) -> UInt8[np.ndarray, "H W 3"]:
    """A few training frames, spread over time: well-lit, dark, and the dark one scaled to the well-lit mean."""
    split = dataset.train
    assert split.welllit is not None
    in_time = np.argsort(split.cameras.time, kind="stable")
    chosen = in_time[evenly_spread(len(in_time), rows)].tolist()
    gain = float(split.welllit[chosen].mean(dtype=np.float64) / max(split.images[chosen].mean(dtype=np.float64), 1e-6))
    lines = [
        (
            f"{split.names[i]}, time {split.cameras.time[i]:.2f}",
            [to_bytes(x) for x in (split.welllit[i], split.images[i], gain * split.images[i].astype(np.float32))],
        )
        for i in chosen
    ]
    return sheet(["well-lit", "low light", f"low light x {gain:.3g}"], lines)


def _sources(dataset: Dataset) -> Iterator[Float16[np.ndarray, "H W 3"]]:
    """The well-lit pictures of all frames: those of `Split.welllit`, or else the only ones."""
    splits = [split for split in (dataset.train, dataset.test) if split.names]
    known = [split.welllit is not None for split in splits]
    if any(known) and not all(known):
        raise UserError(f"{dataset.name}: has well-lit pictures of one split only; expected them of all frames or none")
    for split in splits:
        yield from split.images if split.welllit is None else split.welllit


def _counted(dataset: Dataset) -> list[Bool[np.ndarray, "H W"]]:
    """Which pixels of each frame are valid."""
    everything = np.ones((dataset.height, dataset.width), bool)
    splits = (dataset.train, dataset.test)
    return [x for split in splits for x in (len(split.names) * [everything] if split.valid is None else split.valid)]


def _exposures(count: int, cfg: DarkeningConfig) -> list[float]:
    if cfg.exposure is not None:
        return [cfg.exposure] * count
    drawn = np.random.default_rng(cfg.seed).uniform(*cfg.exposure_range, count)
    return drawn.tolist() if cfg.per_image else [float(drawn[0])] * count


def _lights(dataset: Dataset, cfg: DarkeningConfig) -> list[float]:
    """Factors on the light of all frames: a sine wave over time with a random phase."""
    times = np.concatenate([split.cameras.time for split in (dataset.train, dataset.test)])
    begin = np.random.default_rng((cfg.seed, 1)).uniform()
    return (1 + cfg.exposure_drift * np.sin(2 * np.pi * (begin + DRIFT_PERIODS * times))).tolist()


def _darkened(
    pictures: Sequence[Bytes],
    counted: Sequence[Bool[np.ndarray, "H W"]],
    exposures: Sequence[float],
    name: str,
    cfg: DarkeningConfig,
) -> Callable[[int], darkening.Image]:
    """A function that darkens each frame, by index; what is fitted is fitted to the pixels that count.

    Raises:
        UserError: the pictures are not brighter than the exposure, or the weights cannot be read.
    """

    def pixels(i: int) -> Float32[np.ndarray, "P 1 3"]:
        return _floats(pictures[i])[counted[i]][:, None]

    def light(pixels: Float32[np.ndarray, "P 1 3"]) -> Float32[np.ndarray, " P"]:
        return darkening.lightness(pixels, cfg.lab_order)[:, 0]

    def by_lightness(i: int, darkener: darkening.Darkener) -> darkening.Image:
        return darkening.darken(_floats(pictures[i]), exposures[i], darkener, cfg.lab_order, cfg.allow_brightening)

    stride = -(-sum(picture.size // 3 for picture in pictures) // SAMPLED_PIXELS)
    sample = np.concatenate([pixels(i)[::stride] for i in range(len(pictures))])
    sampled = light(sample)
    if sampled.mean() <= darkening.exposure_map(sampled, min(exposures)).mean():
        raise UserError(
            f"{name}: the mean lightness of its pictures is {sampled.mean():.3f}; "
            f"expected brighter ones than the exposure, {min(exposures):.3f}, or a lower --exposure"
        )
    fitted_to = pixels if cfg.per_image else lambda _: sample
    if cfg.method == "network":
        network = darkening.network_darkener(weights.load(cfg.weights or weights.SHIPPED))
        return lambda i: by_lightness(i, network)
    if cfg.method == "camera":
        factor = functools.cache(lambda i: darkening.light_factor(fitted_to(i), exposures[i], cfg.lab_order))
        return lambda i: darkening.scale_light(_floats(pictures[i]), factor(i if cfg.per_image else 0))
    analytic = functools.cache(lambda i: darkening.analytic_darkener(light(fitted_to(i)), exposures[i]))
    return lambda i: by_lightness(i, analytic(i if cfg.per_image else 0))


def _twin(split: Split, dark: list[Bytes], welllit: list[Bytes]) -> Split:
    if not dark:
        return split
    in_file = isinstance(split.images, MappedArray)
    return dataclasses.replace(split, images=_stack(dark, in_file), welllit=_stack(welllit, in_file))


def _stack(pictures: list[Bytes], in_file: bool) -> Float16[np.ndarray, "F H W 3"]:
    """Values in [0, 1] as half floats, like the frames of a data set."""
    return stacked(map(_floats, pictures), (len(pictures), *pictures[0].shape), np.float16, in_file)


def _floats(picture: Bytes) -> darkening.Image:
    return picture.astype(np.float32) / 255


def mean_report(frames: dict[str, FrameReport]) -> dict[str, float | None]:
    """Means of the reports over the frames; None if a frame has None."""
    columns = zip(*frames.values(), strict=True)
    return {
        key: None if None in values else float(np.mean(values))
        for key, values in zip(FrameReport._fields, columns, strict=True)
    }
