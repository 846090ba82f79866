"""With which way of brightening dark frames most of them get a pose.

    python -m experiments.quality.compare_brightening FRAMES_OR_VIDEO

Prepares the same frames with each of the curves below, on one thread, and prints the results. Only the copies in which
flow and features are found differ.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2

from l2dgs_jax.errors import UserError
from l2dgs_jax.preprocess.capture import CaptureConfig, prepare
from l2dgs_jax.preprocess.capture.brighten import Tone, brighten
from l2dgs_jax.runtime import command_line

CURVES = {
    "as they are": lambda image, tone: brighten(image, Tone(1.0, 1.0, 0.0)),
    "gain and exponent": lambda image, tone: brighten(image, tone._replace(smoothing=0.0)),
    "gain, exponent, CLAHE": lambda image, tone: cv2.createCLAHE(3, (8, 8)).apply(
        brighten(image, tone._replace(smoothing=0.0))
    ),
    "gain, exponent, smoothing": brighten,
}


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    options = parser.parse_args(arguments)
    for name, curve in CURVES.items():
        with tempfile.TemporaryDirectory() as folder:
            try:
                found = prepare(options.source, Path(folder) / "out", CaptureConfig(threads=1), curve)
            except UserError as error:
                print(f"{name}: {error}")
                continue
        figures = {key: found[key] for key in ("registered", "sampled", "points", "reprojection_error_px")}
        print(f"{name}: {figures}, focal length {found['camera']['focal_length_px']}", flush=True)


if __name__ == "__main__":
    command_line.run(main)
