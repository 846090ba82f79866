"""Files as torch.save writes them, made without PyTorch from pickle opcodes."""

import io
import pickle
import struct
import zipfile
from typing import NamedTuple

import numpy as np

STORAGES = {
    "float64": "DoubleStorage",
    "float32": "FloatStorage",
    "float16": "HalfStorage",
    "int64": "LongStorage",
    "bool": "BoolStorage",
}
ORDERED_DICT = b"ccollections\nOrderedDict\n)R"


class View(NamedTuple):
    """A tensor on (part of) the storage of elements `flat`; tensors of one storage share the array."""

    flat: np.ndarray
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


def state_dict(tensors, *, legacy, extra_elements=0):
    """The pickle of a state_dict, and the bytes of its storages by key.

    Args:
        tensors: arrays or views by name.
        legacy: references to storages as in legacy files.
        extra_elements: that the storages claim and do not have.
    """
    flats, memo = {}, iter(range(2**16))
    text = lambda s: b"X" + struct.pack("<I", len(s)) + s.encode() + b"r" + struct.pack("<I", next(memo))
    number = lambda n: b"J" + struct.pack("<i", n)
    sequence = lambda values: b"(" + b"".join(map(number, values)) + b"t"
    out = [b"\x80\x02", ORDERED_DICT, b"("]
    for name, tensor in tensors.items():
        view = tensor if isinstance(tensor, View) else contiguous(tensor)
        key = str(next((k for k, flat in flats.items() if flat is view.flat), len(flats)))
        flats[key] = view.flat
        storage = f"ctorch\n{STORAGES[str(view.flat.dtype)]}\n".encode()
        reference = [b"(", text("storage"), storage, text(key), text("cuda:0"), number(view.flat.size + extra_elements)]
        out += [text(name), b"ctorch._utils\n_rebuild_tensor_v2\n(", *reference, b"N" * legacy, b"tQ"]
        out += [number(view.offset), sequence(view.shape), sequence(view.strides), b"\x89", ORDERED_DICT, b"tR"]
    out += [b"u}", text("_metadata"), ORDERED_DICT, b"sb."]
    return b"".join(out), {key: flat.tobytes() for key, flat in flats.items()}


def contiguous(array):
    whole = array.copy()
    return View(whole.ravel(), 0, whole.shape, tuple(stride // whole.itemsize for stride in whole.strides))


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
    """The bytes of a file in the format before PyTorch 1.6; storages are of floats of 4 bytes unless said otherwise."""
    system = {"protocol_version": 1001, "little_endian": little_endian, "type_sizes": {"short": 2, "int": 4, "long": 4}}
    parts = [pickle.dumps(x, 2) for x in (0x1950A86A20F9469CFC6C, 1001, system)]
    parts += [content, pickle.dumps(sorted(raw), 2)]
    for key in sorted(raw):
        parts += [struct.pack("<q", len(raw[key]) // (itemsizes or {}).get(key, 4)), raw[key]]
    return b"".join(parts)


def saved(tensors, *, legacy):
    """The bytes of a whole file that holds `tensors`."""
    content, raw = state_dict(tensors, legacy=legacy)
    if not legacy:
        return zip_file(content, raw)
    flats = [x.flat if isinstance(x, View) else x for x in tensors.values()]
    return legacy_file(content, raw, itemsizes={str(i): flat.itemsize for i, flat in enumerate(flats)})
