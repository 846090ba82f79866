"""Frames of one size stacked into one array: in memory, or in a memory-mapped temporary file."""

import math
import mmap
import tempfile
from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from numpy.typing import DTypeLike

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.files import reserve


class MappedArray(np.ndarray):
    """A read-only array over a memory-mapped file; indexing it, or iterating over its frames, returns copies.

    Pages that were read are released at once to the system's file cache, so that only what is being copied counts as
    memory of the process.
    """

    def __getitem__(self, key: Any) -> Any:
        taken = np.array(self.view(np.ndarray)[key])[()]
        if isinstance(self.base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
            self.base.madvise(mmap.MADV_DONTNEED)
        return taken


def stacked(
    frames: Iterable[Shaped[np.ndarray, "..."]], shape: tuple[int, ...], dtype: DTypeLike, in_file: bool
) -> Shaped[np.ndarray, "..."]:
    """The frames as one array, without ever holding them twice.

    Args:
        frames: `shape[0]` frames, each of shape `shape[1:]`.
        shape: of the stack.
        dtype: of the stack.
        in_file: whether to return a `MappedArray`. Its file lies, without a name, in the folder for temporary files
            (TMPDIR), and vanishes when the array is no longer used, however the process ends.

    Raises:
        UserError: there is no room for the file.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if not in_file or not size:
        stack = np.empty(shape, dtype)
        for index, frame in zip(range(len(stack)), frames, strict=True):
            stack[index] = frame
        return stack
    try:
        with tempfile.TemporaryFile() as file:
            reserve(file.fileno(), size)
            for _, frame in zip(range(shape[0]), frames, strict=True):
                file.write(np.ascontiguousarray(frame, dtype).data)
            file.flush()
            return MappedArray(shape, dtype, mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ))
    except OSError as error:
        raise UserError(
            f"{tempfile.tempdir or 'TMPDIR'}: cannot hold {size / 2**30:.2g} GiB of frames ({error.strerror}); "
            "expected TMPDIR to name a writable folder that can"
        ) from None


def evenly_spread(count: int, most: int) -> Int[np.ndarray, " N"]:
    """Indices of at most so many of `count` items, from the first one to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def pixel_mean(
    stack: Shaped[np.ndarray, "F H W *C"], valid: Bool[np.ndarray, "F H W"] | None = None, below: float | None = None
) -> Float[np.ndarray, "*C"]:
    """The mean over all pixels, or those that are `valid` and with all channels `below` a value; NaN if there are none.

    Only one frame at a time is in memory.
    """
    total, count = np.zeros(stack.shape[3:]), 0
    for index, frame in enumerate(stack):
        counted = np.ones(frame.shape[:2], bool) if valid is None else valid[index]
        if below is not None:
            counted = counted & (frame.max(-1) < below)
        total += frame.sum((0, 1), np.float64, where=counted.reshape(*counted.shape, *[1] * total.ndim))
        count += int(counted.sum())
    return np.asarray(total / count)


def nan_median(stack: Float[np.ndarray, "F P 3"]) -> Float[np.ndarray, "P 3"]:
    """Median over the first axis, ignoring NaN; faster than NumPy's."""
    last = np.count_nonzero(~np.isnan(stack), axis=0, keepdims=True) - 1
    ordered = np.sort(stack, axis=0)  # NaN last
    return np.take_along_axis(ordered, np.concatenate([last // 2, (last + 1) // 2]), axis=0).mean(0)
