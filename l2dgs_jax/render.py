"""`python -m l2dgs_jax.render RUN`: a run's views, or a camera path through its scene, as pictures or videos."""

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from l2dgs_jax.errors import UserError
from l2dgs_jax.runs import Run, open_run, pictures, shots
from l2dgs_jax.runs.pictures import Output
from l2dgs_jax.runs.shots import FLIGHTS, Shots
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import make_folder
from l2dgs_jax.types import RenderOutput
from l2dgs_jax.visualize import display, films

DEFAULT_FRAMES = 96  # of a camera path
MAX_SIDE = 16382  # pixels; video codecs take no more


@dataclass(frozen=True)
class Render:
    """Render a run to DIR/PATH/OUTPUT/NAME.png, or with --format video to DIR/PATH/OUTPUT.mp4 (.webm without PyAV).

    Frames that exist already are not rendered again. Depth pictures have 16 bits: a value v means a depth of v * unit,
    in the units of the scene's cameras, and 0 that nothing is drawn; DIR/PATH/depth.json holds the unit.

    Attributes:
        run: folder of the run.
        path: camera path. dataset: the views of a split (PATH above is then its name); interpolate: along the training
            views; spiral: around the most central training view; orbit: around what the cameras look at; freeze-time:
            along the training views while time stands still; freeze-camera: a fixed camera while time runs; or a
            camera_path.json of nerfstudio (PATH above is then its name).
        split: views to render, for --path dataset.
        frames: number of pictures along a path; 96 if not given.
        times: first and last instant of a path, in [0, 1]; 0 and 1 if not given.
        at: instant that freeze-time shows, or whose camera freeze-camera uses; 0.5 if not given.
        outputs: images to render.
        side_by_side: put the outputs next to each other in one picture.
        size: size of a picture in pixels, WIDTH or WIDTHxHEIGHT; another aspect ratio crops the view, it does not
            stretch it.
        format: png, exr (floating point; well-lit and low-light images in linear light), or video.
        fps: frames per second of a video; if not given, those of the camera_path.json, or 24.
        output: the folder DIR; RUN/renders if not given (RUN/renders_coarse for the coarse stage).
        stage: the last checkpoint ("final"), or the one at the end of the coarse stage ("coarse").
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    path: Annotated[str, tyro.conf.arg(metavar="NAME|FILE.json")] = "dataset"
    split: Literal["test", "train"] = "test"
    frames: int | None = None
    times: tuple[float, float] | None = None
    at: float | None = None
    outputs: tuple[Output, ...] = ("welllit", "lowlight", "illumination", "reflectance", "depth")
    side_by_side: bool = False
    size: Annotated[str | None, tyro.conf.arg(metavar="WIDTH[xHEIGHT]")] = None
    format: Literal["png", "exr", "video"] = "png"
    fps: float | None = None
    output: Path | None = None
    stage: Literal["final", "coarse"] = "final"

    def check(self) -> None:
        """Check the options as far as that is possible before the run is read.

        Raises:
            UserError: an option is invalid, or cannot be combined with another one.
        """
        flies, freezes = self.path in FLIGHTS, self.path in ("freeze-time", "freeze-camera")
        if not flies and self.path != "dataset" and not os.path.isfile(self.path):
            raise UserError(f"--path {self.path}: no such file; expected one, or dataset, {', '.join(FLIGHTS)}")
        if not flies and (self.frames is not None or self.times is not None):
            raise UserError(f"--path {self.path}: has its own frames; expected no --frames and no --times")
        if not freezes and self.at is not None:
            raise UserError(f"--at {self.at:g}: nothing stands still; expected --path freeze-time or freeze-camera")
        for instant in (*(self.times or ()), *([] if self.at is None else [self.at])):
            if not 0 <= instant <= 1:
                raise UserError(f"--times, --at: {instant:g} is no instant; expected 0, the first, to 1, the last")
        if self.frames is not None and self.frames < 1:
            raise UserError(f"--frames {self.frames}: expected at least 1")
        if self.side_by_side and (len(self.outputs) < 2 or self.format == "exr"):
            raise UserError("--side-by-side: expected at least two --outputs, and --format png or video")
        if not self.outputs or len(set(self.outputs)) < len(self.outputs):
            raise UserError(f"--outputs {' '.join(self.outputs)}: expected at least one, and none of them twice")
        if self.size is not None and not re.fullmatch(r"[0-9]{1,5}(x[0-9]{1,5})?", self.size):
            raise UserError(f"--size {self.size}: expected WIDTH or WIDTHxHEIGHT in pixels")


def main(arguments: Sequence[str]) -> None:
    """Render as the command line says."""
    options = command_line.parse(Render, arguments, "render")
    options.check()
    run = open_run(options.run, options.stage)
    wanted = _shots(run, options)
    base = options.output or options.run / ("renders" if options.stage == "final" else "renders_coarse")
    make_folder(base / wanted.title)
    write = _write_videos if options.format == "video" else _write_frames
    write(run, wanted, base / wanted.title, options)


def _shots(run: Run, options: Render) -> Shots:
    if options.path == "dataset":
        wanted = shots.of_split(run, options.split)
    elif options.path in FLIGHTS:
        first, last = options.times or (0.0, 1.0)
        times = np.linspace(first, last, options.frames or DEFAULT_FRAMES)
        wanted = shots.of_flight(run, options.path, times, 0.5 if options.at is None else options.at)
    else:
        wanted = shots.of_file(run, Path(options.path))
    width, height = wanted.size
    if options.size:
        sides = [int(side) for side in options.size.split("x")]
        width, height = sides if len(sides) == 2 else (sides[0], max(1, round(height * sides[0] / width)))
    longest = max(width * (len(options.outputs) if options.side_by_side else 1), height)
    if min(width, height) < 1 or longest > MAX_SIDE:
        source = f"--size {options.size}" if options.size else f"--path {options.path}"
        raise UserError(f"{source}: {width}x{height} pixels; expected at least 1, and no picture over {MAX_SIDE}")
    fps = wanted.fps if options.fps is None else options.fps
    if not 0.1 <= fps <= 1000:
        raise UserError(f"{fps:g} frames a second; expected --fps from 0.1 to 1000")
    return (wanted.resized((width, height)) if options.size else wanted)._replace(fps=fps)


def _write_frames(run: Run, wanted: Shots, folder: Path, options: Render) -> None:
    draw: Callable[[RenderOutput], pictures.Pictures]
    if options.side_by_side:
        name = "-".join(options.outputs)
        ranges = films.sampled_ranges(run, wanted.cameras, options.outputs, wanted.size)
        kinds, draw = [name], lambda output: {name: display.side_by_side(output, options.outputs, ranges)}
    else:
        kinds = list(options.outputs)
        draw = partial(pictures.as_floats if options.format == "exr" else pictures.as_integers, kinds=options.outputs)
    suffix: Literal[".png", ".exr"] = ".exr" if options.format == "exr" else ".png"
    new = pictures.write_frames(run, wanted, folder, kinds, draw, suffix)
    there = len(wanted.names) - new
    print(f"wrote {new} views to {folder}{f'; {there} were there already' if there else ''}")


def _write_videos(run: Run, wanted: Shots, folder: Path, options: Render) -> None:
    groups = [options.outputs] if options.side_by_side else [(kind,) for kind in options.outputs]
    shown = {folder / "-".join(kinds): kinds for kinds in groups}
    files = films.write_videos(run, wanted.cameras, shown, size=wanted.size, fps=wanted.fps)
    print(f"wrote {' and '.join(map(str, files))}")


if __name__ == "__main__":
    command_line.run(main, huge_pages=True)
