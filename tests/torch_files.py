"""Files as torch.save writes them, made without PyTorch."""

import io
import pickle
import struct
import sys
import zipfile
from collections import OrderedDict
from types import ModuleType
from typing import NamedTuple
from unittest import mock

import numpy as np

TORCH, UTILS = ModuleType("torch"), ModuleType("torch._utils")
STORAGES = {
    "float64": "DoubleStorage",
    "float32": "FloatStorage",
    "float16": "HalfStorage",
    "int64": "LongStorage",
    "bool": "BoolStorage",
}
for name in STORAGES.values():
    setattr(TORCH, name, type(name, (), {"__module__": "torch"}))
UTILS._rebuild_tensor_v2 = type("_rebuild_tensor_v2", (), {"__module__": "torch._utils"})


class View(NamedTuple):
    """A tensor on (part of) the storage of elements `flat`; tensors of one storage share the array."""

    flat: np.ndarray
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class Storage(tuple):
    """The persistent id of a storage."""


class Pickler(pickle.Pickler):
    """Pickles views and storages as PyTorch does; the names that it writes are looked up in `sys.modules`."""

    def __init__(self, stream, protocol, storage):
        super().__init__(stream, protocol)
        self.storage = storage

    def persistent_id(self, value):
        return tuple(value) if isinstance(value, Storage) else None

    def reducer_override(self, value):
        if not isinstance(value, View):
            return NotImplemented
        shape, strides = (*value.shape,), (*value.strides,)  # tuples of its own, as each tensor gives them
        return UTILS._rebuild_tensor_v2, (self.storage(value.flat), value.offset, shape, strides, False, OrderedDict())


def state_dict(tensors, *, legacy, extra_elements=0, protocol=2):
    """The pickle of a state_dict, and the bytes of its storages by key.

    Args:
        tensors: arrays or views by name.
        legacy: references to storages as in legacy files.
        extra_elements: that the storages claim and do not have.
        protocol: of the pickle.
    """
    flats = {}

    def storage(flat):
        key = next((key for key, known in flats.items() if known is flat), str(len(flats)))
        flats[key] = flat
        kind = getattr(TORCH, STORAGES[str(flat.dtype)])
        return Storage(("storage", kind, key, "cuda:0", flat.size + extra_elements, *[None] * legacy))

    saved = OrderedDict((name, x if isinstance(x, View) else contiguous(x)) for name, x in tensors.items())
    saved._metadata = OrderedDict({"": {"version": 1}, "conv": {"version": 1}})
    stream = io.BytesIO()
    with mock.patch.dict(sys.modules, {"torch": TORCH, "torch._utils": UTILS}):
        Pickler(stream, protocol, storage).dump(saved)
    return stream.getvalue(), {key: flat.tobytes() for key, flat in flats.items()}


def contiguous(array):
    copied = array.copy()
    return View(copied.ravel(), 0, copied.shape, tuple(stride // copied.itemsize for stride in copied.strides))


def zip_file(content, raw, *, byteorder=b"little", compression=zipfile.ZIP_STORED):
    """The bytes of a file in the format of PyTorch 1.6 and later."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        entries = {"data.pkl": content, "byteorder": byteorder, "version": b"3\n"}
        entries |= {f"data/{key}": values for key, values in raw.items()}
        for name, values in entries.items():
            archive.writestr(zipfile.ZipInfo(f"saved/{name}"), values, compression)
    return stream.getvalue()


def legacy_file(content, raw, *, itemsizes=None, little_endian=True):
    """The bytes of a file in the format before PyTorch 1.6; storages are of floats of 4 bytes by default."""
    system = {"protocol_version": 1001, "little_endian": little_endian, "type_sizes": {"short": 2, "int": 4, "long": 4}}
    parts = [pickle.dumps(x, 2) for x in (0x1950A86A20F9469CFC6C, 1001, system)]
    parts += [content, pickle.dumps(sorted(raw), 2)]
    for key in sorted(raw):
        parts += [struct.pack("<q", len(raw[key]) // (itemsizes or {}).get(key, 4)), raw[key]]
    return b"".join(parts)


def saved(tensors, *, legacy, protocol=2):
    """The bytes of a whole file that holds `tensors`."""
    content, raw = state_dict(tensors, legacy=legacy, protocol=protocol)
    if not legacy:
        return zip_file(content, raw)
    flats = [x.flat if isinstance(x, View) else x for x in tensors.values()]
    return legacy_file(content, raw, itemsizes={str(i): flat.itemsize for i, flat in enumerate(flats)})
