"""The devices that a training is spread over, in one process or in several."""

import contextlib
import importlib.util
import itertools
import os
import re
from collections.abc import Iterator
from typing import TypeVar

import jax
import jaxlib
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, PyTree

# Axes of a device mesh: members of an ensemble, and views of a batch.
MEMBERS, VIEWS = "members", "views"

T = TypeVar("T")


def one_per_core() -> None:
    """Make every CPU core a device, unless the user or a caller has set the number of CPU devices.

    XLA runs most loops of a program on one core. Two programs, each with one view of the step, keep two cores busy.
    """
    chosen = jax.config.jax_num_cpu_devices  # type: ignore[attr-defined]
    if chosen < 0 and "host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        with contextlib.suppress(RuntimeError):  # too late: the process has already used jax
            jax.config.update("jax_num_cpu_devices", cores)


def use_atomic_additions() -> None:
    """On NVIDIA GPUs, let XLA use atomic instructions to add floats to memory; works only before jax has started.

    jaxlib before 0.11.1 otherwise adds them by compare-and-swap loops (jax issue 38806), because the instruction
    flushes subnormal numbers to zero; the flag allows all of XLA to do so.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if not any(importlib.util.find_spec(f"jax_cuda{version}_plugin") for version in (12, 13)):
        return
    numbers = [int(part) for part in re.findall(r"\d+", jaxlib.__version__)[:3]]
    if numbers < [0, 11, 1] and "xla_gpu_ftz" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_ftz=true".strip()


def shares(views: int) -> int:
    """The largest number of devices that share a batch of `views` evenly."""
    return max(count for count in range(1, jax.device_count() + 1) if views % count == 0)


def mesh(members: int = 1, views: int = 1) -> Mesh | None:
    """A mesh of `members` x `views` devices, taken from all processes in turn; None for one device of one process.

    Raises:
        ValueError: there are not that many devices, or a process would be left without any.
    """
    count = members * views
    by_process = [[d for d in jax.devices() if d.process_index == p] for p in range(jax.process_count())]
    found = [device for rank in itertools.zip_longest(*by_process) for device in rank if device is not None]
    if count == 1 and jax.process_count() == 1:
        return None
    if count > len(found):
        raise ValueError(f"{count} devices are wanted, {len(found)} found")
    used = sorted(found[:count], key=lambda device: (device.process_index, device.id))
    if len({device.process_index for device in used}) < jax.process_count():
        raise ValueError(f"{count} devices leave some of the {jax.process_count()} processes without any")
    return Mesh(np.array(used).reshape(members, views), (MEMBERS, VIEWS))


def shard(tree: PyTree, mesh: Mesh | None, *axes: str) -> PyTree:
    """Shard host arrays, which every process holds whole: their first axes are spread over `axes` of the mesh."""
    if mesh is None:
        return tree
    sharding = NamedSharding(mesh, PartitionSpec(*axes))

    def spread(leaf: np.ndarray | Array) -> Array:
        whole = np.asarray(leaf, jax.dtypes.canonicalize_dtype(leaf.dtype))
        return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])

    return jax.tree.map(spread, tree)


def member(tree: T, index: int) -> T:
    """Row `index` of all arrays of a tree; this process must hold that row (see `own_rows`)."""

    def pick(x: Array) -> Array:
        for shard in x.addressable_shards:
            rows = range(*shard.index[0].indices(x.shape[0]))
            if index in rows:
                return shard.data[index - rows.start]
        raise KeyError(f"row {index} lies in another process")

    return jax.tree.map(pick, tree)


def own_rows(array: Array) -> Iterator[int]:
    """The rows that this process reports on: those that it holds and no process of a lower index does."""
    holders: dict[int, int] = {}
    for shard in array.global_shards:
        for index in range(*shard.index[0].indices(array.shape[0])):
            holders[index] = min(shard.device.process_index, holders.get(index, shard.device.process_index))
    return (index for index, holder in sorted(holders.items()) if holder == jax.process_index())


def mean_over(tree: T, axis: str | None) -> T:
    """Mean over the devices of an axis of `jax.shard_map`; with `axis` None, for a single device, `tree` itself."""
    return tree if axis is None else jax.lax.pmean(tree, axis)


def max_over(x: Array, axis: str | None) -> Array:
    """Like `mean_over`, the maximum."""
    return x if axis is None else jax.lax.pmax(x, axis)
