"""The order in which training sees its views, and reading them ahead of their use."""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np
from jaxtyping import Int

from l2dgs_jax.threads import in_order

T = TypeVar("T")


def batches(
    load: Callable[[Int[np.ndarray, " B"]], T], steps: Iterable[int], seed: int, batch_size: int, num_frames: int
) -> Iterator[T]:
    """The batch of each of `steps`, read a few steps ahead on threads, so that no step waits for a disk.

    Close the iterator to end the threads before the last step.

    Args:
        load: reads the views of given indices; must not depend on the order of its calls.
        steps: of the run, in order.
        seed: see `view_indices`.
        batch_size: see `view_indices`.
        num_frames: see `view_indices`.

    Raises:
        Exception: what `load` raises, in the place of the batch.
    """
    return in_order(lambda step: load(view_indices(seed, step, batch_size, num_frames)), steps)


def view_indices(seed: int, step: int, batch_size: int, num_frames: int) -> Int[np.ndarray, " B"]:
    """The views of one training step.

    All steps together read an endless row of random permutations of the frames, `batch_size` at a time: every epoch
    shows each frame once, whether or not the batch size divides the number of frames. A pure function of its
    arguments, so a resumed run sees what the uninterrupted one would have.

    Args:
        seed: of the run.
        step: of the run, from 0.
        batch_size: views a step, B.
        num_frames: frames to choose from.
    """
    epochs, places = np.divmod(step * batch_size + np.arange(batch_size), num_frames)
    orders = {epoch: _permutation(seed, epoch, num_frames) for epoch in set(epochs.tolist())}
    return np.array([orders[epoch][place] for epoch, place in zip(epochs.tolist(), places, strict=True)])


def _permutation(seed: int, epoch: int, num_frames: int) -> Int[np.ndarray, " F"]:
    return np.random.default_rng((seed % 2**64, epoch)).permutation(num_frames)
