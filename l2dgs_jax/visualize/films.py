"""Videos of a run."""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax

from l2dgs_jax.cameras import select_camera
from l2dgs_jax.cameras.paths import space_time_path
from l2dgs_jax.data.stacks import evenly_spread
from l2dgs_jax.runs.pictures import Output
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runs.shots import DEFAULT_FPS
from l2dgs_jax.runs.views import views
from l2dgs_jax.types import Camera
from l2dgs_jax.visualize import display
from l2dgs_jax.visualize.video import open_video, video_path

RUN_VIDEO_SECONDS = 4  # length of the video that `train` writes
RANGE_VIEWS = 8  # views from which the ranges of colour maps are taken


def write_run_video(run: Run, stem: Path, *, quiet: bool = False) -> Path:
    """Write a short flight through space and time: the estimate of the dark input on the left, well-lit on the right.

    Args:
        run: the run.
        stem: the file without its suffix.
        quiet: show no progress.

    Returns:
        The file.

    Raises:
        UserError: the file cannot be written.
    """
    cameras = space_time_path(run.dataset.train.cameras, RUN_VIDEO_SECONDS * DEFAULT_FPS)
    return write_videos(run, cameras, {stem: ("lowlight", "welllit")}, quiet=quiet)[0]


def write_videos(
    run: Run,
    cameras: Camera,
    shown: Mapping[Path, Sequence[Output]],
    *,
    size: tuple[int, int] | None = None,
    fps: float | int = DEFAULT_FPS,
    quiet: bool = False,
) -> list[Path]:
    """Write videos of the same cameras, whole or not at all.

    Args:
        run: the run.
        cameras: a batch with one camera per frame.
        shown: for each file without its suffix, the outputs that it shows side by side.
        size: width and height of each of these pictures, pixels; the data set's if not given.
        fps: frames per second.
        quiet: show no progress.

    Returns:
        The files.

    Raises:
        UserError: a file cannot be written.
    """
    width, height = size = size or (run.dataset.width, run.dataset.height)
    ranges = sampled_ranges(run, cameras, [kind for kinds in shown.values() for kind in kinds], size)
    with contextlib.ExitStack() as stack:
        videos = []
        for stem, kinds in shown.items():
            videos.append((stack.enter_context(open_video(stem, (len(kinds) * width, height), fps)), kinds))
        for output in views(run, cameras, size, quiet):
            for add, kinds in videos:
                add(display.side_by_side(output, kinds, ranges))
    return [video_path(stem) for stem in shown]


def sampled_ranges(
    run: Run, cameras: Camera, kinds: Sequence[Output], size: tuple[int, int] | None = None
) -> display.Ranges:
    """Ranges of colour maps, from a few of the cameras; empty if no kind of output needs one."""
    if not set(kinds) & set(display.COLOR_MAPPED):
        return {}
    renderer = run.renderer(*size or (None, None))
    chosen = evenly_spread(len(cameras.time), RANGE_VIEWS)
    return display.ranges([jax.device_get(renderer(select_camera(cameras, int(i)))) for i in chosen])
