"""Damaged and malicious files, and how a reader refuses them."""

import tracemalloc

import numpy as np
import pytest

from l2dgs_jax.errors import UserError

MANY = 10_000
# They begin soundly; a careless reader runs out of memory or never ends.
GREEDY_PICKLES = {
    "nested lists": b"\x80\x02]" + MANY * b"]" + MANY * b"a" + b".",
    "nested dictionaries": b"\x80\x02}" + MANY * b"X\0\0\0\0}" + MANY * b"s" + b".",
    "marks": b"\x80\x02" + MANY * b"(" + b".",
    "memo index": b"\x80\x02}r\xff\xff\xff\x7fj\xff\xff\xff\x7f\x86.",
    "doubled": b"\x80\x02)" + 60 * b"q\x00h\x00\x86" + b".",
    "long text": b"\x80\x02X\xff\xff\xff\xffabc.",
    "long bytes": b"\x80\x04\x8e" + 7 * b"\xff" + b"\x7fabc.",
    "long number": b"\x80\x02\x8b\xff\xff\xff\x7fabc.",
    "called text": b"\x80\x02X\x03\x00\x00\x00abc)R.",
}
NESTED_TUPLES = b")" + 250_000 * b"\x85"  # the hash of which exhausts the stack
NESTED_KEY = b"\x80\x02}" + NESTED_TUPLES + b"Ns."


def load_bytes(load, folder, content):
    path = folder / "unsound"
    path.write_bytes(content)
    return load(path)


def refusal(load, folder, content):
    """The one sentence with which a file of that content is refused."""
    with pytest.raises(UserError) as caught:
        load_bytes(load, folder, content)
    message = str(caught.value)
    assert message.startswith(f"{folder / 'unsound'}: ")
    assert "expected" in message
    assert "\n" not in message
    return message


def frugal_refusal(load, folder, content):
    """The same sentence, given after using little memory."""
    tracemalloc.start()
    try:
        message = refusal(load, folder, content)
        assert tracemalloc.get_traced_memory()[1] < 2**23 + 4 * len(content)
    finally:
        tracemalloc.stop()
    return message


def assert_mutations_are_harmless(load, folder, sound, count, seed):
    """Truncated files and files with bytes changed give arrays or a UserError; `sound` are the files in turn."""
    rng = np.random.default_rng(seed)
    refused = 0
    for i in range(count):
        content = bytearray(sound[i % len(sound)])
        if rng.random() < 0.2:
            del content[rng.integers(len(content)) :]
        else:
            for offset in rng.integers(len(content), size=rng.integers(1, 4)):
                content[offset] = rng.integers(256)
        try:
            loaded = load_bytes(load, folder, bytes(content))
        except UserError:
            refused += 1
        else:
            assert all(isinstance(array, np.ndarray) for array in loaded.values())
    assert refused > count / 3
