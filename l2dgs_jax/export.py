"""`python -m l2dgs_jax.export RUN --to FORMAT`: the well-lit scene, or a camera path, for other programs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from tqdm import tqdm

from l2dgs_jax.cameras.geometry import mean_up
from l2dgs_jax.errors import UserError
from l2dgs_jax.exporters import antimatter15, gltf, ply, web_page
from l2dgs_jax.exporters.baking import OVERBRIGHT, bake, closeness, near_plane
from l2dgs_jax.exporters.camera_path import camera_path
from l2dgs_jax.exporters.model_arrays import model_arrays
from l2dgs_jax.exporters.splats import Splats, visible
from l2dgs_jax.exporters.tracks import quantise
from l2dgs_jax.runs import Run, is_needed, open_run
from l2dgs_jax.runs.views import get_split
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import make_folder, new_folder, replacing, write_json

DEFAULT_FILES = {  # in RUN/exports, if --output is not given
    "ply": "scene.ply",
    "splat": "scene.splat",
    "gltf": "scene.glb",
    "cloud": "cloud.ply",
    "html": "scene.html",
    "npz": "scene.npz",
    "cameras": "camera_path.json",
}
FORMATS_WITHOUT = {"time": ("html", "npz", "cameras"), "times": ("npz", "cameras")}  # formats that reject an option
MAX_KEY_INSTANTS = 48  # of a page, unless --times asks for more
BYTE_COLOR_FORMATS = ("splat", "cloud")  # they store colours as bytes, so nothing can be brighter than white


@dataclass(frozen=True)
class Export:
    """Export a run: its well-lit scene at one or many instants for splat viewers, a web page, or the whole model.

    Colours are baked: each Gaussian gets the one colour with which the well-lit images are matched best. The PSNR that
    this reaches is printed.

    Attributes:
        run: folder of the run.
        to: format to write: Gaussians as a "ply" of 3D Gaussian Splatting, a "splat" of antimatter15's viewer or a
            "gltf" with KHR_gaussian_splatting; their centres as a point "cloud" (.ply); the moving scene as a web page
            ("html"); the whole model as arrays ("npz"); or the "cameras" of a split as a nerfstudio camera path.
        output: file to write, or with --times the folder; in RUN/exports if not given.
        time: instant to write, from 0 (first frame) to 1 (last frame); 0.5 if not given.
        times: number of instants to write, evenly spaced from 0 to 1, as frame0001, frame0002 ... in a new folder. For
            "html", the number of key instants between which the page interpolates; if not given, one per frame, but at
            most 48.
        split: views whose cameras are exported, for --to cameras.
        fps: frames per second of the camera path, or of the clip that the page plays.
        stage: the last checkpoint ("final"), or the one at the end of the coarse stage ("coarse").
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    to: Literal["ply", "splat", "gltf", "cloud", "html", "npz", "cameras"]
    output: Path | None = None
    time: float | None = None
    times: int | None = None
    split: Literal["train", "test"] = "train"
    fps: int = 24
    stage: Literal["final", "coarse"] = "final"

    @property
    def sequence(self) -> bool:
        """Whether a folder with one file per instant is written."""
        return self.times is not None and self.to != "html"


def main(arguments: Sequence[str]) -> None:
    """Export as the command line says."""
    options = command_line.parse(Export, arguments, "export")
    _check(options)
    run = open_run(options.run, options.stage)
    path = options.output or options.run / "exports" / (options.to if options.sequence else DEFAULT_FILES[options.to])
    make_folder(path.parent)
    if options.to == "cameras":
        split = get_split(run, options.split)
        write_json(path, camera_path(split.cameras, run.dataset.width, run.dataset.height, options.fps))
        print(f"wrote {len(split.names)} cameras to {path}")
    elif options.to == "npz":
        arrays = model_arrays(run)
        with replacing(path) as temporary:
            np.savez(temporary, **arrays)  # type: ignore[arg-type]
        print(f"wrote {len(arrays)} arrays to {path}")
    elif options.to == "html":
        _write_page(run, options, path)
    else:
        _write_splats(run, options, path)


def _check(options: Export) -> None:
    """Reject options that are out of range or cannot be combined, before anything is read."""
    instants = {name: value for name, value in (("time", options.time), ("times", options.times)) if value is not None}
    for name, value in instants.items():
        if options.to in FORMATS_WITHOUT[name]:
            others = ", ".join(to for to in DEFAULT_FILES if to not in FORMATS_WITHOUT[name])
            raise UserError(f"--{name} {value}: {options.to} covers all instants; expected it with one of {others}")
    if len(instants) == 2:
        raise UserError(f"--times {options.times}: given beside --time {options.time}; expected one of the two")
    if options.time is not None and not 0 <= options.time <= 1:
        raise UserError(f"--time {options.time}: expected an instant from 0, the first frame, to 1, the last")
    for name, count in (("times", options.times), ("fps", options.fps)):
        if count is not None and count < 1:
            raise UserError(f"--{name} {count}: expected a whole number from 1")
    if options.to == "html" and options.times == 1:
        raise UserError("--times 1: html interpolates between instants; expected at least 2")
    suffix = Path(DEFAULT_FILES[options.to]).suffix
    if options.output and not options.sequence and options.output.suffix != suffix:
        raise UserError(f"--output {options.output}: expected a file name that ends in {suffix}")
    if options.output and is_needed(options.output, options.run):
        raise UserError(f"--output {options.output}: a file of the run itself; expected another one")


def _write_splats(run: Run, options: Export, path: Path) -> None:
    """Bake and write one file, or a folder of them."""
    encoders: dict[str, Callable[[Splats], bytes]] = {
        "ply": ply.encode,
        "splat": antimatter15.encode,
        "gltf": partial(gltf.encode, up=mean_up(np.asarray(run.dataset.train.cameras.viewmat))),
        "cloud": ply.encode_cloud,
    }
    middle = 0.5 if options.time is None else options.time
    times = np.linspace(0, 1, options.times).tolist() if options.times else [middle]
    brightest = 1.0 if options.to in BYTE_COLOR_FORMATS else OVERBRIGHT
    counts, scores = [], []
    with new_folder(path) if options.sequence else replacing(path) as target:
        baked = bake(run, times, brightest)
        baked = tqdm(baked, total=len(times), desc="export", unit="instant", dynamic_ncols=True)
        for number, (splats,) in enumerate(baked, 1):
            shown = visible(splats)
            if not len(shown.means):
                raise UserError(f"{run.name}: nothing is visible at time {times[number - 1]}; expected a trained scene")
            file = target / f"frame{number:04d}{Path(DEFAULT_FILES[options.to]).suffix}" if options.sequence else target
            file.write_bytes(encoders[options.to](shown))
            counts.append(len(shown.means))
            scores.append(closeness(run, splats, times[number - 1]))
    files = f"{len(times)} files of " if options.sequence else ""
    total = len(splats.means)
    print(f"wrote {files}{_range(counts, 'd')} visible Gaussians, of {total} in all, to {path}")
    if options.to != "cloud":
        print(f"PSNR of their images against the exact well-lit images: {_range(scores, '.2f')} dB")


def _write_page(run: Run, options: Export, path: Path) -> None:
    """Bake key instants into one page."""
    split = run.dataset.train
    frames = len(np.union1d(split.cameras.time, run.dataset.test.cameras.time))
    count = options.times or min(max(frames, 2), MAX_KEY_INSTANTS)
    with replacing(path) as temporary:
        baked = bake(run, np.linspace(0, 1, count).tolist(), OVERBRIGHT, web_page.IMAGES)
        instants = list(tqdm(baked, total=count, desc="export", unit="instant", dynamic_ncols=True))
        if not any(len(visible(welllit).means) for welllit, _ in instants):
            raise UserError(f"{run.name}: nothing is visible; expected a trained scene")
        tracks = quantise(instants, web_page.pixel_sizes(split.cameras, instants, near_plane(run)), OVERBRIGHT)
        scores = web_page.compare(run, tracks)
        temporary.write_text(web_page.page(run, tracks, scores, frames / options.fps), "utf-8")
    print(f"wrote {path}, {path.stat().st_size / 1e6:.1f} MB")
    for image, of_image in zip(("well-lit", "low-light"), scores.T.tolist(), strict=True):
        print(f"PSNR of its images against the exact {image} images: {_range(of_image, '.2f')} dB")


def _range(values: Sequence[int] | Sequence[float], form: str) -> str:
    low, high = format(min(values), form), format(max(values), form)
    return low if low == high else f"{low} to {high}"


if __name__ == "__main__":
    command_line.run(main, huge_pages=True)
