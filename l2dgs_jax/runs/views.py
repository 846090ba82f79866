"""The views of a run's scene, rendered one after the other."""

from collections.abc import Iterator

import jax
from tqdm import tqdm

from l2dgs_jax.data.dataset import Split
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runtime.prefetch import prefetch
from l2dgs_jax.types import RenderOutput


def views(run: Run, split: Split) -> Iterator[RenderOutput]:
    """Render the views of `split` in order, as NumPy arrays, showing progress."""
    renderer = run.renderer()
    outputs = prefetch(lambda i: jax.device_get(renderer(split.camera(i))), range(len(split.names)))
    yield from tqdm(outputs, total=len(split.names), desc="render", unit="view", dynamic_ncols=True, disable=None)


def get_split(run: Run, name: str) -> Split:
    """The run's "test" or "train" views.

    Raises:
        UserError: there are none.
    """
    split: Split = getattr(run.dataset, name)
    if not len(split.names):
        raise UserError(f"{run.name}: its scene has no {name} views; expected some, or --split train")
    return split
