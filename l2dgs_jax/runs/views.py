"""Rendering views of a run one after the other."""

from collections.abc import Iterator

import jax
from tqdm import tqdm

from l2dgs_jax.cameras import select_camera
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import Camera, RenderOutput


def views(
    run: Run, cameras: Camera, size: tuple[int, int] | None = None, quiet: bool = False
) -> Iterator[RenderOutput]:
    """Render a batch of cameras in order, as NumPy arrays, showing progress on a terminal.

    Args:
        run: the run.
        cameras: the batch.
        size: width and height of the images, pixels; the data set's if not given.
        quiet: show no progress.
    """
    renderer = run.renderer(*size or (None, None))
    count = len(cameras.time)
    outputs = prefetch(lambda i: jax.device_get(renderer(select_camera(cameras, i))), range(count))
    hidden = quiet or None  # None: hidden if there is no terminal
    yield from tqdm(outputs, total=count, desc="render", unit="view", dynamic_ncols=True, disable=hidden)


def get_split(run: Run, name: str) -> Split:
    """The run's "test" or "train" views.

    Raises:
        UserError: there are none.
    """
    split: Split = getattr(run.dataset, name)
    if not len(split.names):
        raise UserError(f"{run.name}: its scene has no {name} views; expected some, or --split train")
    return split
