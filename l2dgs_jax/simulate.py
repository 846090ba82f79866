"""`python -m l2dgs_jax.simulate SCENE OUT`: a low-light twin of a scene, with the scene itself as its truth."""

import dataclasses
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Bool, Float16, Float32, UInt8
from tqdm import tqdm

from l2dgs_jax import cli, darkeners, lowlight, metrics, visualize
from l2dgs_jax.config import Layout
from l2dgs_jax.data import load, nerfies
from l2dgs_jax.data.dataset import Dataset, Split
from l2dgs_jax.data.images import to_bytes, write_image
from l2dgs_jax.errors import UserError
from l2dgs_jax.files import new_folder

SETTINGS = "simulate.json"
CONTACT_SHEET = "contact_sheet.png"
Bytes = UInt8[np.ndarray, "H W 3"]
MOST = 1e9  # electrons
SAMPLE = 1_000_000  # pixels of a video that the analytic curve is fitted to


@dataclass(frozen=True)
class Simulate:
    """Darken a well-lit scene as L2DGS and LEDNet did, and write it in the layout of Nerfies: rgb dark, well as it was.

    Beside it, simulate.json says how and how dark every frame became, and contact_sheet.png shows some.

    Attributes:
        scene: folder of the scene, in any known layout; its well-lit pictures if it has both kinds.
        output: new folder for the twin.
        downscale: whole factor by which images are smaller than full size.
        format: layout of the scene's folder; "auto": found from its contents.
        held_out: rule for the views not trained on, as train has it; frames that it does not use are left out.
        method: one analytic curve for the whole video, or curves by a network, which sees every pixel's neighbourhood.
        weights: of the network: LEDNet's ce_zerodce.pth or an .npz of experiments.train_darkener; else our own.
        exposure: mean lightness of the dark frames, saturated pixels aside; drawn from the range if not given.
        exposure_range: lowest and highest exposure to draw (LEDNet: 0.05 0.3).
        per_image: draw an exposure for every frame, which makes videos flicker, instead of one for all.
        photons: electrons that white stands for; gives the sensor noise if set.
        read_noise: of that sensor, in electrons.
        lab_order: lightness as it should be, or with red and blue swapped as in LEDNet's script.
        allow_brightening: let pixels become brighter where the network says so, as LEDNet does.
        seed: of exposures and noise.
    """

    scene: tyro.conf.Positional[str]
    output: tyro.conf.Positional[Path]
    downscale: int = 1
    format: Layout = "auto"
    held_out: str = "auto"
    method: Literal["analytic", "network"] = "analytic"
    weights: Path | None = None
    exposure: float | None = None
    exposure_range: tuple[float, float] = (0.05, 0.08)
    per_image: bool = False
    photons: float | None = None
    read_noise: float = 2.0
    lab_order: lowlight.LabOrder = "correct"
    allow_brightening: bool = False
    seed: int = 0


class FrameReport(NamedTuple):
    """How dark a frame became.

    Attributes:
        exposure: that was asked for.
        psnr: dB, of the dark frame against the well-lit one; None if they are equal.
        level: mean sRGB value of the dark frame.
        welllit_level: of the well-lit one.
    """

    exposure: float
    psnr: float | None
    level: float
    welllit_level: float


def simulate(arguments: Sequence[str]) -> None:
    """Simulate as the command line says."""
    options = cli.parse(Simulate, arguments, "simulate")
    _check(options)
    with new_folder(options.output) as folder:
        dataset = load(options.scene, options.downscale, options.format, options.held_out)
        for note in dataset.notes:
            print(f"note: {note}")
        dataset, frames = darken(dataset, options)
        nerfies.write(dataset, folder)
        summary = _summary(frames)
        settings = {key: str(x) if isinstance(x, Path) else x for key, x in dataclasses.asdict(options).items()}
        content = {"settings": settings, "mean": summary, "frames": {k: v._asdict() for k, v in frames.items()}}
        (folder / SETTINGS).write_text(json.dumps(content, indent=2) + "\n")
        write_image(folder / CONTACT_SHEET, contact_sheet(dataset))
    decibels = "some frames unchanged" if summary["psnr"] is None else f"PSNR(low, well) {summary['psnr']:.2f} dB"
    print(
        f"{dataset.name}: {len(frames)} frames, mean level {summary['welllit_level']:.3f} -> {summary['level']:.3f}, "
        f"{decibels}; wrote {options.output}, see {options.output / CONTACT_SHEET}"
    )


def darken(dataset: Dataset, options: Simulate) -> tuple[Dataset, dict[str, FrameReport]]:
    """The low-light twin of a scene: its pictures darkened, themselves as the truth; and a report on every frame.

    Colours of points are dropped: they were seen in the light.

    Raises:
        UserError: the scene is no brighter than the exposure, or has well-lit pictures of some frames only.
    """
    names = dataset.train.names + dataset.test.names
    pictures = [to_bytes(picture) for picture in _sources(dataset)]
    exposures = _exposures(len(names), options)
    darkener = _darkener(pictures, _counted(dataset), exposures, options)
    frames: dict[str, FrameReport] = {}
    dark: list[Bytes] = []
    for i, name in enumerate(tqdm(names, desc="darken", unit="frame", dynamic_ncols=True)):
        image = _floats(pictures[i])
        low = lowlight.darken(image, exposures[i], darkener(i), options.lab_order, options.allow_brightening)
        if options.photons is not None:
            low = lowlight.add_sensor_noise(low, (options.seed, i), options.photons, options.read_noise)
        dark.append(lowlight.truncate(low))
        low = _floats(dark[i])
        psnr = float(metrics.psnr(jnp.asarray(low), jnp.asarray(image)))
        finite = psnr if math.isfinite(psnr) else None
        frames[name] = FrameReport(exposures[i], finite, float(low.mean()), float(image.mean()))

    first = len(dataset.train.names)
    return dataclasses.replace(
        dataset,
        train=_twin(dataset.train, dark[:first], pictures[:first]),
        test=_twin(dataset.test, dark[first:], pictures[first:]),
        colors=None,
    ), frames


def contact_sheet(dataset: Dataset, rows: int = 4) -> UInt8[np.ndarray, "H W 3"]:
    """A few training frames, spread over time: well-lit, dark, and the dark one brought back to the same mean."""
    split = dataset.train
    assert split.welllit is not None
    in_time = np.argsort(split.cameras.time, kind="stable")
    chosen = in_time[np.unique(np.linspace(0, len(in_time) - 1, rows).round().astype(int))].tolist()
    gain = float(split.welllit[chosen].mean(dtype=np.float64) / max(split.images[chosen].mean(dtype=np.float64), 1e-6))
    lines = [
        (
            f"{split.names[i]}, time {split.cameras.time[i]:.2f}",
            [to_bytes(x) for x in (split.welllit[i], split.images[i], gain * split.images[i].astype(np.float32))],
        )
        for i in chosen
    ]
    return visualize.sheet(["well-lit", "low light", f"low light x {gain:.3g}"], lines)


def _check(options: Simulate) -> None:
    """Refuse settings that make no sense before anything is read.

    Raises:
        UserError: there is one.
    """
    low, high = options.exposure_range if options.exposure is None else (options.exposure,) * 2
    if not 0 < low <= high < 1:
        name = "--exposure-range" if options.exposure is None else "--exposure"
        raise UserError(f"{name}: is {low:g} ... {high:g}; expected mean lightnesses between 0 (black) and 1 (white)")
    if options.weights is not None and options.method != "network":
        raise UserError("--weights: go with --method network; expected that method, or no weights")
    if options.photons is not None and not (0 < options.photons <= MOST and 0 <= options.read_noise <= MOST):
        raise UserError(f"--photons and --read-noise: expected electrons, more than 0 and from 0, at most {MOST:g}")
    if options.seed < 0:
        raise UserError(f"--seed {options.seed}: expected a whole number from 0")


def _sources(dataset: Dataset) -> Iterator[Float16[np.ndarray, "H W 3"]]:
    """The well-lit pictures of all frames: those called so, or else the only ones."""
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


def _exposures(count: int, options: Simulate) -> list[float]:
    if options.exposure is not None:
        return [options.exposure] * count
    drawn = np.random.default_rng(options.seed).uniform(*options.exposure_range, count)
    return drawn.tolist() if options.per_image else [float(drawn[0])] * count


def _darkener(
    pictures: Sequence[Bytes],
    counted: Sequence[Bool[np.ndarray, "H W"]],
    exposures: Sequence[float],
    options: Simulate,
) -> Callable[[int], lowlight.Darkener]:
    """The darkener of every frame, by its index, as its pixels that count suggest.

    Raises:
        UserError: the pictures are no brighter than the exposure, or the weights cannot be read.
    """
    light = lambda i: lowlight.lightness(_floats(pictures[i]), options.lab_order)[counted[i]]
    stride = -(-sum(picture.size // 3 for picture in pictures) // SAMPLE)
    sample = np.concatenate([light(i)[::stride] for i in range(len(pictures))])
    if sample.mean() <= lowlight.exposure_map(sample, min(exposures)).mean():
        raise UserError(
            f"{options.scene}: the mean lightness of its pictures is {sample.mean():.3f}; "
            f"expected brighter ones than the exposure, {min(exposures):.3f}, or a lower --exposure"
        )
    if options.method == "network":
        network = lowlight.network_darkener(darkeners.load(options.weights or darkeners.SHIPPED))
        return lambda _: network
    if options.per_image:
        return lambda i: lowlight.analytic_darkener(light(i), exposures[i])
    analytic = lowlight.analytic_darkener(sample, exposures[0])
    return lambda _: analytic


def _twin(split: Split, dark: list[Bytes], welllit: list[Bytes]) -> Split:
    if not dark:
        return split
    stack = lambda pictures: np.stack([_floats(picture).astype(np.float16) for picture in pictures])
    return dataclasses.replace(split, images=stack(dark), welllit=stack(welllit))


def _floats(picture: Bytes) -> Float32[np.ndarray, "H W 3"]:
    return picture.astype(np.float32) / 255


def _summary(frames: dict[str, FrameReport]) -> dict[str, float | None]:
    """Means over the frames; None where some frame has none."""
    columns = zip(*frames.values(), strict=True)
    return {
        key: None if None in values else float(np.mean(values))
        for key, values in zip(FrameReport._fields, columns, strict=True)
    }


if __name__ == "__main__":
    cli.main(simulate)
