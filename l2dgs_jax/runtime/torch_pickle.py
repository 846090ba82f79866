"""Tensors saved by PyTorch as NumPy arrays: without PyTorch, and without running code from the pickle.

`torch.save` pickles an object in which every tensor is a view of a storage, named by a key. The bytes of the storages
are other entries of the same zip archive or, before PyTorch 1.6, follow the pickle in the same file ("legacy").
"""

import io
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.runtime.pickles import Arrays, dictionary, follow
from l2dgs_jax.runtime.reading import RefusedError, read_file

_ZIP_START = b"PK\x03\x04"
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_VERSION = 1001
_DTYPES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "<i1",
    "ByteStorage": "<u1",
    "BoolStorage": "?",
}
_MOST_DIMENSIONS = 64  # of a NumPy array
_LARGEST_EXPANSION = 4  # of all tensors, which may share storages, over the size of the file


def load(path: Path) -> Arrays:
    """Read a dictionary of tensors, such as `torch.save(model.state_dict(), path)` writes, in either format.

    The pickle can build dictionaries, lists and tensors; anything else is refused.

    Args:
        path: the file. Devices that it names are ignored.

    Returns:
        The arrays in the file's order, each with memory of its own.

    Raises:
        UserError: the file is missing, damaged, or holds something else.
    """
    return read_file(path, _read, "a dictionary of tensors, as torch.save writes a state_dict")


class _Storage(NamedTuple):
    key: str
    dtype: str
    elements: int


class _Tensor(NamedTuple):
    """A view of a storage; offset and strides count elements."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


def _read(content: bytes) -> Arrays:
    tensors, storages = (_read_zip if content.startswith(_ZIP_START) else _read_legacy)(content)
    filled = sum(math.prod(tensor.shape) * np.dtype(tensor.storage.dtype).itemsize for tensor in tensors.values())
    if filled > _LARGEST_EXPANSION * len(content):
        raise RefusedError("holds tensors that together are many times larger than the file")
    return {name: _array(tensor, storages[tensor.storage.key]) for name, tensor in tensors.items()}


def _read_zip(content: bytes) -> tuple[dict[str, _Tensor], dict[str, bytes]]:
    """The tensors by name, and the bytes of their storages by key."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/data.pkl"))
        folder = name.removesuffix("data.pkl")
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
            raise RefusedError("is a compressed archive")
        if sum(entry.file_size for entry in archive.infolist()) > len(content):
            raise ValueError("entries that overlap")
        if f"{folder}byteorder" in archive.namelist() and archive.read(f"{folder}byteorder") != b"little":
            raise RefusedError("was saved on a big-endian machine")
        tensors = _tensors(io.BytesIO(archive.read(name)))
        return tensors, {key: archive.read(f"{folder}data/{key}") for key in _storages(tensors)}


def _read_legacy(content: bytes) -> tuple[dict[str, _Tensor], dict[str, bytes]]:
    """Like `_read_zip`, for a legacy file: magic number, version, system, object, list of keys, and the storages."""
    stream = io.BytesIO(content)
    magic, version, system = (follow(stream, {}) for _ in range(3))
    if (magic, version) != (_LEGACY_MAGIC, _LEGACY_VERSION):
        raise ValueError("another kind of pickle")
    if not system["little_endian"]:
        raise RefusedError("was saved on a big-endian machine")
    tensors = _tensors(stream)
    storages = _storages(tensors)
    raw = {}
    for key in follow(stream, {}):
        if not isinstance(key, str):  # other keys could be nested too deep to be hashed
            raise ValueError("not the key of a storage")
        count = int.from_bytes(stream.read(8), "little")
        raw[key] = stream.read(count * np.dtype(storages[key].dtype).itemsize)
    return tensors, raw


def _tensors(stream: io.BytesIO) -> dict[str, _Tensor]:
    saved = follow(stream, _STAND_INS, reusable=(_Tensor,), persistent=_storage)
    if not isinstance(saved, dict) or not all(isinstance(tensor, _Tensor) for tensor in saved.values()):
        raise RefusedError("holds something else")
    return saved


def _storages(tensors: dict[str, _Tensor]) -> dict[str, _Storage]:
    return {tensor.storage.key: tensor.storage for tensor in tensors.values()}


def _storage(reference: Any) -> _Storage:
    """The storage that a persistent id refers to."""
    kind, dtype, key, _device, count, *view = reference
    known = kind == "storage" and dtype in _DTYPES.values() and isinstance(key, str) and _natural([count])
    if not known or view not in ([], [None]):
        raise ValueError("not a reference to a storage")
    return _Storage(key, dtype, count)


def _tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> _Tensor:
    """Stands in for PyTorch's `_rebuild_tensor_v2`; the view must lie within its storage."""
    sound = isinstance(storage, _Storage) and len(shape) == len(strides) <= _MOST_DIMENSIONS
    if not sound or not _natural([offset, *shape, *strides]):
        raise ValueError("not the arguments of a tensor")
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    # Repeated elements (stride 0) could make a small file fill the memory; weights are not saved like that.
    if 0 not in shape and (last >= storage.elements or math.prod(shape) > storage.elements):
        raise ValueError("a tensor larger than its storage")
    return _Tensor(storage, offset, tuple(shape), tuple(strides))


_STAND_INS = {
    "collections OrderedDict": dictionary,
    "torch._utils _rebuild_tensor_v2": _tensor,
    **{f"torch {storage}": dtype for storage, dtype in _DTYPES.items()},
}


def _array(tensor: _Tensor, storage: bytes) -> Shaped[np.ndarray, "..."]:
    elements = np.frombuffer(storage, tensor.storage.dtype)
    if len(elements) != tensor.storage.elements:
        raise ValueError("a storage of another length")
    strides = [elements.itemsize * stride for stride in tensor.strides]
    return np.lib.stride_tricks.as_strided(elements[tensor.offset :], tensor.shape, strides).copy()


def _natural(values: Sequence[Any]) -> bool:
    return all(type(value) is int and value >= 0 for value in values)
