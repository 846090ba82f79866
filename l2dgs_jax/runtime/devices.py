"""The devices that a training is spread over, in one process or several."""

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

# Axes of a mesh: members of an ensemble, and views of a batch.
MEMBERS, VIEWS = "members", "views"

T = TypeVar("T")


def one_per_core() -> None:
    """Make every processor core a device of its own, unless the user or a caller has settled how many there are.

    XLA runs most loops of a program on one core. Two programs, each with a view of the step, keep two cores busy.
    """
    chosen = jax.config.jax_num_cpu_devices  # type: ignore[attr-defined]
    if chosen < 0 and "host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        with contextlib.suppress(RuntimeError):  # too late: the process has used jax before
            jax.config.update("jax_num_cpu_devices", cores)


def use_atomic_additions() -> None:
    """On NVIDIA GPUs, have floats added to memory by one instruction; in effect only before jax has started.

    jaxlib before 0.11.1 otherwise adds them by loops that compare and swap (jax issue 38806), because the instruction
    takes subnormal numbers for zero; the flag says that all of XLA may.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if not any(importlib.util.find_spec(f"jax_cuda{version}_plugin") for version in (12, 13)):
        return
    numbers = [int(part) for part in re.findall(r"\d+", jaxlib.__version__)[:3]]
    if numbers < [0, 11, 1] and "xla_gpu_ftz" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_ftz=true".strip()


def shares(views: int) -> int:
    """The most devices that share a batch of so many views evenly."""
    return max(count for count in range(1, jax.device_count() + 1) if views % count == 0)


def mesh(members: int = 1, views: int = 1) -> Mesh | None:
    """`members` x `views` devices, as many of each process as can be; None for the only one of a single process.

    Raises:
        ValueError: there are not that many, or a process would be left without.
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
    """Host arrays as arrays whose first axes are spread over those of the mesh; every process has the whole arrays."""
    if mesh is None:
        return tree
    sharding = NamedSharding(mesh, PartitionSpec(*axes))

    def spread(leaf: np.ndarray | Array) -> Array:
        whole = np.asarray(leaf, jax.dtypes.canonicalize_dtype(leaf.dtype))
        return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])

    return jax.tree.map(spread, tree)


def member(tree: T, index: int) -> T:
    """Row `index` of all arrays of a tree, for which this process must hold it (see `own_rows`)."""

    def pick(x: Array) -> Array:
        for shard in x.addressable_shards:
            rows = range(*shard.index[0].indices(x.shape[0]))
            if index in rows:
                return shard.data[index - rows.start]
        raise KeyError(f"row {index} lies in another process")

    return jax.tree.map(pick, tree)


def own_rows(array: Array) -> Iterator[int]:
    """The rows that are this process's to report on: those that it holds and no process before it."""
    holders: dict[int, int] = {}
    for shard in array.global_shards:
        for index in range(*shard.index[0].indices(array.shape[0])):
            holders[index] = min(shard.device.process_index, holders.get(index, shard.device.process_index))
    return (index for index, holder in sorted(holders.items()) if holder == jax.process_index())


def mean_over(tree: T, axis: str | None) -> T:
    """Means over the devices of an axis of `jax.shard_map`; None for a single device."""
    return tree if axis is None else jax.lax.pmean(tree, axis)


def max_over(x: Array, axis: str | None) -> Array:
    """The maximum over the devices of an axis, as `mean_over`."""
    return x if axis is None else jax.lax.pmax(x, axis)
