"""Which views each training step sees."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from l2dgs_jax.config import Config
from l2dgs_jax.data.dataset import Split
from l2dgs_jax.training.flows import Flows
from l2dgs_jax.training.inbetweens import draw
from l2dgs_jax.training.state import Batch
from l2dgs_jax.types import Camera


def next_batch(split: Split, config: Config, step: int, flows: Flows | None) -> Batch:
    """The views of one training step, a pure function of its arguments.

    Args:
        split: frames to learn from.
        config: seed, batch size, and the share of views between frames.
        step: of the run, from 0.
        flows: optical flow between the frames; None if no view is to lie between frames.
    """
    seed = int(config.seed)
    indices = view_indices(seed, step, config.batch_size, len(split.names))
    batch = load_batch(split, indices)
    if flows is None:
        return batch
    valid = np.ones(batch.images.shape[:-1], bool) if batch.valid is None else batch.valid
    rows: Any = (*batch.cameras, batch.frames, batch.images, valid)
    probabilities = _probabilities_between(split, flows, config.inbetweens)
    uniforms, parts = np.random.default_rng((seed % 2**64, step, 1)).random((2, config.batch_size))
    for row, frame in enumerate(indices.tolist()):
        if uniforms[row] < probabilities[frame]:
            view = draw(split, flows, frame, float(parts[row]))
            for stack, own in zip(rows, (*view.camera, view.frame, view.image, view.valid), strict=True):
                stack[row] = own
            if batch.depths is not None:
                batch.depths[row] = 0  # the depth is not known between frames
    return batch._replace(valid=valid)  # type: ignore[arg-type]


def _probabilities_between(split: Split, flows: Flows, share: float) -> Float[np.ndarray, " F"]:
    """Probability that each frame is replaced by a view between it and the following one.

    The longer the time between them, the more can happen in it: the odds are proportional to it, and those of `share`
    at its mean over the frames. They are 0 for a frame that none follows.
    """
    times = np.asarray(split.cameras.time, np.float64)
    gaps = times[flows.following] - times
    odds = share * gaps * np.count_nonzero(gaps) / max(gaps.sum(), 1e-9)
    return odds / np.maximum(1 - share + odds, 1e-9)


def load_batch(split: Split, indices: Int[np.ndarray, " V"]) -> Batch:
    """The frames of `indices`."""
    valid = None if split.valid is None else split.valid[indices]
    depths = None if split.depths is None else split.depths[indices]
    if depths is not None and valid is not None:
        depths[~valid] = 0
    cameras = Camera(*(x[indices] for x in split.cameras))
    return Batch(cameras, split.images[indices], np.array(indices, np.int32), valid, depths)  # type: ignore[arg-type]


def view_indices(seed: int, step: int, batch_size: int, num_frames: int) -> Int[np.ndarray, " B"]:
    """The frames of one training step.

    All steps together read an endless sequence of random permutations of the frames, `batch_size` at a time: every
    epoch shows each frame once, whether or not the batch size divides the number of frames. A pure function of its
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
