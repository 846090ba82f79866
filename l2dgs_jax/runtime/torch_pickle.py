"""Tensors that PyTorch saved, as NumPy arrays: without PyTorch, and without running what a pickle may ask for.

`torch.save` pickles an object in which every tensor is a view of a storage named by a key. The bytes of the storages
lie beside the pickle in a zip archive, or, before PyTorch 1.6, behind it in the same file ("legacy").
"""

import io
import math
import pickle
import pickletools
import zipfile
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime.pickles import RefusedError, refused

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


def load(path: Path) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Read a dictionary of tensors, such as `torch.save(model.state_dict(), path)` writes, in either format.

    The pickle can build dictionaries, lists and tensors, and nothing else; whatever more it asks for is refused.

    Args:
        path: the file. Devices that it names are ignored.

    Returns:
        The arrays in the file's order, each with memory of its own.

    Raises:
        UserError: the file is missing, damaged, or holds something else.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); expected a file that torch.save wrote") from None
    read = _read_zip if content.startswith(_ZIP_START) else _read_legacy
    try:
        saved, storages = read(content)
        if not isinstance(saved, dict) or not all(
            isinstance(v, _Tensor) and isinstance(k, str) for k, v in saved.items()
        ):
            raise RefusedError("holds something else; expected a dictionary of tensors, as a model's state_dict")
        return {name: _array(tensor, storages) for name, tensor in saved.items()}
    except RefusedError as refusal:
        raise UserError(f"{path}: {refusal}") from None
    except Exception:  # damaged archives and pickles raise whatever their bytes lead to
        raise UserError(f"{path}: damaged or of another kind; expected a whole file that torch.save wrote") from None


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


class _Unpickler(pickle.Unpickler):
    """Builds descriptions of tensors and notes the storages that they need."""

    def __init__(self, stream: io.BytesIO):
        super().__init__(stream)
        self.storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return self._rebuild_tensor
        if module == "torch" and name in _DTYPES:
            return _DTYPES[name]
        raise refused(module, name, "plain tensors")

    def persistent_load(self, pid: Any) -> _Storage:
        kind, dtype, key, _device, count, *view = pid
        known = kind == "storage" and dtype in _DTYPES.values() and isinstance(key, str) and _natural([count])
        if not known or view not in ([], [None]):
            raise ValueError("not a reference to a storage")
        storage = _Storage(key, dtype, count)
        if self.storages.setdefault(key, storage) != storage:
            raise ValueError("one storage in two forms")
        return storage

    def _rebuild_tensor(self, storage: _Storage, offset: int, shape: tuple, strides: tuple, *_: Any) -> _Tensor:
        """Stands in for PyTorch's function of the same purpose; the view must lie within its storage."""
        if not isinstance(storage, _Storage) or len(shape) != len(strides) or not _natural([offset, *shape, *strides]):
            raise ValueError("not the arguments of a tensor")
        last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
        # Repeated elements (stride 0) could make a small file fill the memory; no weights are saved so.
        if 0 not in shape and (last >= storage.elements or math.prod(shape) > storage.elements):
            raise ValueError("a tensor larger than its storage")
        return _Tensor(storage, offset, tuple(shape), tuple(strides))


def _read_zip(content: bytes) -> tuple[Any, dict[str, bytes]]:
    """The pickled object and the bytes of its storages, by key."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/data.pkl"))
        folder = name.removesuffix("data.pkl")
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
            raise RefusedError("is a compressed archive; expected one as torch.save writes it")
        if f"{folder}byteorder" in archive.namelist() and archive.read(f"{folder}byteorder") != b"little":
            raise RefusedError("was saved on a big-endian machine; expected little-endian numbers")
        saved, storages = _unpickle(io.BytesIO(archive.read(name)))
        return saved, {key: archive.read(f"{folder}data/{key}") for key in storages}


def _read_legacy(content: bytes) -> tuple[Any, dict[str, bytes]]:
    """The same of a legacy file: magic number, version, system, object and list of keys, then all storages."""
    stream = io.BytesIO(content)
    magic, version, system = (_unpickle(stream)[0] for _ in range(3))
    if (magic, version) != (_LEGACY_MAGIC, _LEGACY_VERSION):
        raise ValueError("another kind of pickle")
    if not system["little_endian"]:
        raise RefusedError("was saved on a big-endian machine; expected little-endian numbers")
    saved, storages = _unpickle(stream)
    raw = {}
    for key in _unpickle(stream)[0]:
        count = int.from_bytes(stream.read(8), "little")
        raw[key] = stream.read(count * np.dtype(storages[key].dtype).itemsize)
    return saved, raw


def _unpickle(stream: io.BytesIO) -> tuple[Any, dict[str, _Storage]]:
    """The next pickled object in the stream and the storages that it refers to."""
    start, size = stream.tell(), len(stream.getbuffer())
    for opcode, argument, _ in pickletools.genops(stream):
        # A memo index sizes a table in memory: a damaged one would ask for gigabytes.
        if "PUT" in opcode.name and isinstance(argument, int) and argument > size:
            raise ValueError("a memo index beyond any that a file of this size can need")
    stream.seek(start)
    unpickler = _Unpickler(stream)
    return unpickler.load(), unpickler.storages


def _array(tensor: _Tensor, storages: dict[str, bytes]) -> Shaped[np.ndarray, "..."]:
    storage = tensor.storage
    elements = np.frombuffer(storages[storage.key], storage.dtype)
    if len(elements) != storage.elements:
        raise ValueError("a storage of another length")
    strides = [elements.itemsize * stride for stride in tensor.strides]
    return np.lib.stride_tricks.as_strided(elements[tensor.offset :], tensor.shape, strides).copy()


def _natural(values: Sequence[Any]) -> bool:
    return all(type(value) is int and value >= 0 for value in values)
