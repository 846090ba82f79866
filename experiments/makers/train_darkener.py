"""Train the network of `simulate --method network`.

    python -m experiments.makers.train_darkener [IMAGES ...] [--output FILE]

Without images it trains on photographs that come with scikit-image: astronaut (NASA, public domain), camera (CC0,
Lav Varshney), chelsea (CC0, Stefan van der Walt), coffee (CC0, Rachel Michetti) and rocket (SpaceX, public domain).
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import skimage.data
from jaxtyping import Array, Float, Float32
from tqdm import tqdm

from l2dgs_jax.data.images import read_image
from l2dgs_jax.preprocess.lowlight import curve_network, darkening, weights
from l2dgs_jax.runtime import command_line
from l2dgs_jax.training.optimizer import Schedule

PHOTOGRAPHS = ("astronaut", "camera", "chelsea", "coffee", "rocket")
CROP, BATCH = 64, 8  # side of a crop in pixels; crops per step
EXPOSURES = (0.02, 0.3)  # range, drawn log-uniformly
SHRINK = (1.0, 2.2)  # range of the shorter side to which a picture is shrunk, over CROP
TONE = (0.6, 1.6)  # range of the exponent applied to a crop, so that the network sees pictures of every brightness
RATES = (2e-3, 1e-4)  # first and last learning rate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", type=Path, nargs="*")
    parser.add_argument("--output", type=Path, default=weights.SHIPPED)
    parser.add_argument("--width", type=int, default=16)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    command_line.use_compilation_cache()
    command_line.use_huge_pages()

    pictures = [read_image(path) for path in options.images] or [bundled(name) for name in PHOTOGRAPHS]
    planes = [darkening.lightness(picture) for picture in pictures]
    rate = Schedule(*(jnp.float32(value) for value in (*RATES, options.steps)))
    net = curve_network.init(jax.random.key(options.seed), options.width)
    bar = tqdm(batches(planes, options.seed, options.steps), total=options.steps, unit="step", dynamic_ncols=True)
    for step, (net, loss) in enumerate(curve_network.train(net, bar, rate)):  # noqa: B020, B007
        if step % 20 == 0:
            bar.set_postfix_str(f"loss {float(loss):.3f}")
    weights.save(options.output, net)


def bundled(name: str) -> Float32[np.ndarray, "H W 3"]:
    picture = getattr(skimage.data, name)()
    colour = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=-1)
    return colour.astype(np.float32) / 255


def batches(
    planes: list[Float32[np.ndarray, "..."]], seed: int, steps: int
) -> Iterator[tuple[Float[Array, "B H W"], Float[Array, "B H W"]]]:
    """Random crops at random sizes and tones, and their exposure maps."""
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        crops = np.stack([crop(planes[rng.integers(len(planes))], rng) for _ in range(BATCH)])
        exposures = np.exp(rng.uniform(*np.log(EXPOSURES), BATCH))
        maps = [darkening.exposure_map(plane, exposure) for plane, exposure in zip(crops, exposures, strict=True)]
        yield jnp.asarray(crops), jnp.asarray(np.stack(maps))


def crop(plane: Float32[np.ndarray, "h w"], rng: np.random.Generator) -> Float32[np.ndarray, "H W"]:
    scale = CROP * rng.uniform(*SHRINK) / min(plane.shape)
    small = cv2.resize(plane, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    row, column = (rng.integers(size - CROP + 1) for size in small.shape)
    part = small[row : row + CROP, column : column + CROP]
    mirrored = part[:, ::-1] if rng.random() < 0.5 else part
    return np.clip(mirrored, 0, 1) ** np.float32(rng.uniform(*TONE))


if __name__ == "__main__":
    main()
