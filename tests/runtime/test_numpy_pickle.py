"""Pickled arrays: sound files are read, others are refused without any other effect."""

import os
import pickle
from functools import partial

import numpy as np
import pytest
import unsound_files
from unsound_files import GREEDY_PICKLES, NESTED_KEY

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime import numpy_pickle

load = partial(unsound_files.load_bytes, numpy_pickle.load)
refusal = partial(unsound_files.refusal, numpy_pickle.load)
frugal_refusal = partial(unsound_files.frugal_refusal, numpy_pickle.load)


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


@pytest.mark.parametrize("protocol", [3, 4])
def test_arrays_come_back_as_they_were(tmp_path, protocol):
    expected = tree()
    expected |= {f"net/{name}": array for name, array in expected.pop("net").items()}
    loaded = load(tmp_path, pickle.dumps(tree(), protocol))
    assert set(loaded) == set(expected)
    for name, array in expected.items():
        np.testing.assert_array_equal(loaded[name], array, strict=True)
        assert loaded[name].flags.owndata


def test_code_in_a_file_is_not_run(tmp_path):
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
def test_other_files_are_refused(tmp_path, content):
    refusal(tmp_path, content)


def test_missing_files_and_folders_are_refused(tmp_path):
    for path in (tmp_path / "nonsuch.ckpt", tmp_path):
        with pytest.raises(UserError, match="cannot be read"):
            numpy_pickle.load(path)


class ArrayOfBytes:
    """Pickles as an array of the given bytes."""

    def __init__(self, content):
        self.content = content

    def __reduce__(self):
        rebuild, arguments, _ = np.zeros(1).__reduce__()
        return rebuild, arguments, (1, (len(self.content),), np.dtype("u1"), False, self.content)


def test_small_files_that_expand_to_large_arrays_are_refused(tmp_path):
    endless: dict = {}
    endless["self"] = endless
    shared = np.zeros(100)
    doubled = {"a": shared}
    for _ in range(60):
        doubled = {"a": doubled, "b": doubled}
    long_name = {2**16 * "a": {str(i): np.zeros(1) for i in range(1000)}}
    content = bytes(2**16)
    shared_bytes = {str(i): ArrayOfBytes(content) for i in range(1000)}
    np.testing.assert_array_equal(load(tmp_path, pickle.dumps({"a": shared_bytes["0"]}, 4))["a"], np.zeros(2**16))
    for value in (endless, doubled, {"a": shared, "b": shared}, long_name, shared_bytes):
        frugal_refusal(tmp_path, pickle.dumps(value, 4))


@pytest.mark.parametrize("content", GREEDY_PICKLES.values(), ids=GREEDY_PICKLES)
def test_little_memory_is_used_before_a_file_is_refused(tmp_path, content):
    frugal_refusal(tmp_path, content)


def test_nested_keys_do_not_exhaust_the_stack(tmp_path):
    refusal(tmp_path, NESTED_KEY)


def test_mutated_files_are_harmless(tmp_path):
    unsound_files.assert_mutations_are_harmless(numpy_pickle.load, tmp_path, [pickle.dumps(tree(), 4)], 300, 0)
