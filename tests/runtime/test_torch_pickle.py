"""Files of PyTorch in both formats: what is read from sound ones, and that nothing else comes of others."""

import os
import pickle
import zipfile

import numpy as np
import pytest
from torch_files import View, legacy_file, saved, state_dict, zip_file

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime import torch_pickle

FORMATS = pytest.mark.parametrize("legacy", [False, True], ids=["zip", "legacy"])
WRAP = {False: zip_file, True: legacy_file}


def arrays():
    rng = np.random.default_rng(0)
    return {
        "conv.weight": rng.normal(size=(2, 3, 3, 3)).astype(np.float32),
        "conv.bias": rng.normal(size=2),
        "half": rng.normal(size=(4, 1)).astype(np.float16),
        "steps": np.array(7),
        "none": np.zeros((0, 3), np.float32),
        "flags": np.array([True, False]),
    }


def load_dataset(folder, content):
    path = folder / "weights.pth"
    path.write_bytes(content)
    return torch_pickle.load(path)


def refusal(folder, content):
    with pytest.raises(UserError) as caught:
        load_dataset(folder, content)
    message = str(caught.value)
    assert message.startswith(f"{folder / 'weights.pth'}: ")
    assert "expected" in message
    assert "\n" not in message
    return message


@FORMATS
def test_arrays_come_back_as_they_were(tmp_path, legacy):
    loaded = load_dataset(tmp_path, saved(arrays(), legacy=legacy))
    assert list(loaded) == list(arrays())
    for name, array in arrays().items():
        assert loaded[name].dtype == array.dtype
        np.testing.assert_array_equal(loaded[name], array, strict=True)


@FORMATS
def test_views_share_a_storage_but_not_their_memory(tmp_path, legacy):
    flat = np.arange(24, dtype=np.float32)
    views = {"transposed": View(flat, 0, (4, 3), (1, 4)), "part": View(flat, 5, (2, 2), (8, 3))}
    loaded = load_dataset(tmp_path, saved(views, legacy=legacy))
    np.testing.assert_array_equal(loaded["transposed"], flat[:12].reshape(3, 4).T)
    np.testing.assert_array_equal(loaded["part"], [[5, 8], [13, 16]])
    loaded["transposed"][:] = -1
    np.testing.assert_array_equal(loaded["part"], [[5, 8], [13, 16]])


class Payload:
    """Pickles as a call of os.system."""

    def __init__(self, command):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


@FORMATS
@pytest.mark.parametrize("protocol", [2, 4])
def test_code_is_named_and_not_run(tmp_path, legacy, protocol):
    target = tmp_path / "ran"
    content = pickle.dumps({"weight": Payload(f"touch {target}")}, protocol)
    assert f"'{os.name}.system'" in refusal(tmp_path, WRAP[legacy](content, {}))
    assert not target.exists()


@pytest.mark.parametrize(
    "name",
    [
        "builtins\neval",
        "collections\nnamedtuple",
        "torch\nload",
        "torch._utils\n_rebuild_parameter",
        "torch\nBFloat16Storage",
        "numpy\nload",
    ],
)
def test_only_what_tensors_need_is_known(tmp_path, name):
    message = refusal(tmp_path, zip_file(b"\x80\x02c" + name.encode() + b"\n.", {}))
    assert name.replace("\n", ".") in message


def test_dotted_names_do_not_reach_into_what_is_known(tmp_path):
    content = b"\x80\x04\x8c\x0bcollections\x8c\x14OrderedDict.fromkeys\x93."
    assert "OrderedDict.fromkeys" in refusal(tmp_path, zip_file(content, {}))


@FORMATS
@pytest.mark.parametrize(
    "view",
    [
        View(np.zeros(6, np.float32), 0, (7,), (1,)),
        View(np.zeros(6, np.float32), 1, (2, 3), (3, 1)),
        View(np.zeros(6, np.float32), -1, (2,), (1,)),
        View(np.zeros(6, np.float32), 5, (2,), (-1,)),
        View(np.zeros(6, np.float32), 0, (2**30, 2**30), (0, 0)),
        View(np.zeros(6, np.float32), 0, (2, 3), (3,)),
    ],
    ids=["longer", "beyond the end", "before the start", "backwards", "repeated", "ragged"],
)
def test_views_outside_their_storage_are_refused(tmp_path, legacy, view):
    refusal(tmp_path, saved({"weight": view}, legacy=legacy))


@FORMATS
def test_storages_must_be_there_and_whole(tmp_path, legacy):
    tensors = {"a": np.zeros(4, np.float32), "b": np.zeros(3, np.float32)}
    content, raw = state_dict(tensors, legacy=legacy)
    assert set(load_dataset(tmp_path, WRAP[legacy](content, raw))) == {"a", "b"}
    refusal(tmp_path, WRAP[legacy](content, {"0": raw["0"]}))
    refusal(tmp_path, WRAP[legacy](content, raw | {"1": raw["1"][:-4]}))
    refusal(tmp_path, WRAP[legacy](state_dict(tensors, legacy=legacy, extra_elements=2**30)[0], raw))


@FORMATS
def test_a_memo_index_cannot_ask_for_gigabytes(tmp_path, legacy):
    refusal(tmp_path, WRAP[legacy](b"\x80\x02}r\xff\xff\xff\x7f.", {}))


@FORMATS
@pytest.mark.parametrize(
    "value", [[], 3, {"epoch": 3}, {"model": {}}, {1: 2}], ids=["list", "number", "counter", "nested", "keys"]
)
def test_anything_but_a_dictionary_of_tensors_is_refused(tmp_path, legacy, value):
    assert "dictionary of tensors" in refusal(tmp_path, WRAP[legacy](pickle.dumps(value, 2), {}))


def test_byte_order_and_compression(tmp_path):
    content, raw = state_dict({"a": np.zeros(2, np.float32)}, legacy=False)
    assert "big-endian" in refusal(tmp_path, zip_file(content, raw, byteorder=b"big"))
    assert "compressed" in refusal(tmp_path, zip_file(content, raw, compression=zipfile.ZIP_DEFLATED))
    content, raw = state_dict({"a": np.zeros(2, np.float32)}, legacy=True)
    assert "big-endian" in refusal(tmp_path, legacy_file(content, raw, little_endian=False))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"weights", b"\x80\x02.", pickle.dumps(0, 2)])
def test_other_files(tmp_path, content):
    refusal(tmp_path, content)


def test_missing_file_and_folder(tmp_path):
    for path in (tmp_path / "nonsuch.pth", tmp_path):
        with pytest.raises(UserError, match="cannot be read"):
            torch_pickle.load(path)


def assert_mutations_are_harmless(folder, count, seed):
    """Truncated files and files with bytes changed give arrays or a UserError."""
    rng = np.random.default_rng(seed)
    sound = [saved(arrays(), legacy=legacy) for legacy in (False, True)]
    refused = 0
    for i in range(count):
        content = bytearray(sound[i % 2])
        if rng.random() < 0.2:
            del content[rng.integers(len(content)) :]
        else:
            for place in rng.integers(len(content), size=rng.integers(1, 4)):
                content[place] = rng.integers(256)
        try:
            loaded = load_dataset(folder, bytes(content))
        except UserError:
            refused += 1
        else:
            assert all(isinstance(array, np.ndarray) for array in loaded.values())
    assert refused > count / 3


def test_mutated_files(tmp_path):
    assert_mutations_are_harmless(tmp_path, 300, 0)


@pytest.mark.slow
def test_many_mutated_files(tmp_path):
    assert_mutations_are_harmless(tmp_path, 5000, 1)
