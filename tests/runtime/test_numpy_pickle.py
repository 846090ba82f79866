"""Pickled arrays: what is read from sound files, and that nothing else comes of others."""

import os
import pickle

import numpy as np
import pytest

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime import numpy_pickle


def tree():
    rng = np.random.default_rng(0)
    return {
        "net": {"kernel": rng.normal(size=(3, 2)).astype(np.float32), "bias": rng.normal(size=2)},
        "by column": np.asfortranarray(rng.normal(size=(2, 3))),
        "big-endian": np.arange(3, dtype=">i4"),
        "flags": np.array([True, False]),
        "scalar": np.array(7),
        "none": np.zeros((0, 3), np.float16),
    }


def load(folder, content):
    path = folder / "weights.ckpt"
    path.write_bytes(content)
    return numpy_pickle.load(path)


def refusal(folder, content):
    with pytest.raises(UserError) as caught:
        load(folder, content)
    message = str(caught.value)
    assert message.startswith(f"{folder / 'weights.ckpt'}: ")
    assert "expected" in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize("protocol", [3, 4])
def test_arrays_come_back_as_they_were(tmp_path, protocol):
    expected = tree()
    expected |= {f"net/{name}": array for name, array in expected.pop("net").items()}
    loaded = load(tmp_path, pickle.dumps(tree(), protocol))
    assert set(loaded) == set(expected)
    for name, array in expected.items():
        np.testing.assert_array_equal(loaded[name], array, strict=True)
        assert loaded[name].flags.owndata


def test_nothing_that_a_file_asks_for_is_run(tmp_path):
    class Payload:
        def __reduce__(self):
            return os.system, (f"touch {tmp_path / 'run'}",)

    assert "system" in refusal(tmp_path, pickle.dumps({"weight": Payload()}, 4))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "value",
    [3, [], {"epoch": 3}, {1: np.zeros(2)}, np.array([{}, None], object), {"name": np.array(["a"])}],
    ids=["number", "list", "counter", "keys", "objects", "text"],
)
def test_anything_but_dictionaries_of_numbers_is_refused(tmp_path, value):
    refusal(tmp_path, pickle.dumps(value, 4))


@pytest.mark.parametrize("content", [b"", b"weights", b"\x80\x02."])
def test_other_files(tmp_path, content):
    refusal(tmp_path, content)


def test_missing_file_and_folder(tmp_path):
    for path in (tmp_path / "nonsuch.ckpt", tmp_path):
        with pytest.raises(UserError, match="cannot be read"):
            numpy_pickle.load(path)


def test_what_would_make_a_small_file_a_large_one_is_refused(tmp_path):
    endless: dict = {}
    endless["self"] = endless
    shared = np.zeros(100)
    doubled = {"a": shared}
    for _ in range(60):
        doubled = {"a": doubled, "b": doubled}
    for value in (endless, doubled, {"a": shared, "b": shared}):
        refusal(tmp_path, pickle.dumps(value, 4))
    for nested in (100_000 * b"\x85", 60 * b"q\x00h\x00\x86"):  # as keys, which pickle would hash
        refusal(tmp_path, b"\x80\x04})" + nested + b"Ns.")


def test_mutated_files(tmp_path):
    rng = np.random.default_rng(0)
    sound, refused = pickle.dumps(tree(), 4), 0
    for _ in range(300):
        content = bytearray(sound)
        for place in rng.integers(len(content), size=rng.integers(1, 4)):
            content[place] = rng.integers(256)
        try:
            loaded = load(tmp_path, bytes(content))
        except UserError:
            refused += 1
        else:
            assert all(isinstance(array, np.ndarray) for array in loaded.values())
    assert refused > 100
