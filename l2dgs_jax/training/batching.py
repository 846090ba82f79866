"""The order in which training sees its views."""

import numpy as np
from jaxtyping import Int


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
    epochs, positions = np.divmod(step * batch_size + np.arange(batch_size), num_frames)
    orders = {epoch: _permutation(seed, epoch, num_frames) for epoch in set(epochs.tolist())}
    return np.array([orders[epoch][position] for epoch, position in zip(epochs.tolist(), positions, strict=True)])


def _permutation(seed: int, epoch: int, num_frames: int) -> Int[np.ndarray, " F"]:
    return np.random.default_rng((seed % 2**64, epoch)).permutation(num_frames)
