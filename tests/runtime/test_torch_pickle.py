"""Files of PyTorch in both formats: sound ones are read, others are refused without any other effect."""

import io
import os
import pickle
import re
import zipfile
import zlib
from functools import partial

import numpy as np
import pytest
import unsound_files
from torch_files import View, legacy_file, saved, state_dict, zip_file
from unsound_files import GREEDY_PICKLES, NESTED_KEY, NESTED_TUPLES

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime import torch_pickle

FORMATS = pytest.mark.parametrize("legacy", [False, True], ids=["zip", "legacy"])
WRAP = {False: zip_file, True: legacy_file}

load = partial(unsound_files.load_bytes, torch_pickle.load)
refusal = partial(unsound_files.refusal, torch_pickle.load)
frugal_refusal = partial(unsound_files.frugal_refusal, torch_pickle.load)


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


@FORMATS
@pytest.mark.parametrize("protocol", [2, 4])
def test_arrays_come_back_as_they_were(tmp_path, legacy, protocol):
    loaded = load(tmp_path, saved(arrays(), legacy=legacy, protocol=protocol))
    assert list(loaded) == list(arrays())
    for name, array in arrays().items():
        assert loaded[name].dtype == array.dtype
        np.testing.assert_array_equal(loaded[name], array, strict=True)


@FORMATS
def test_views_share_a_storage_but_not_their_memory(tmp_path, legacy):
    flat = np.arange(24, dtype=np.float32)
    views = {"transposed": View(flat, 0, (4, 3), (1, 4)), "part": View(flat, 5, (2, 2), (8, 3))}
    loaded = load(tmp_path, saved(views, legacy=legacy))
    np.testing.assert_array_equal(loaded["transposed"], flat[:12].reshape(3, 4).T)
    np.testing.assert_array_equal(loaded["part"], [[5, 8], [13, 16]])
    loaded["transposed"][:] = -1
    np.testing.assert_array_equal(loaded["part"], [[5, 8], [13, 16]])


@FORMATS
def test_a_storage_may_be_shared_by_a_few_tensors_only(tmp_path, legacy):
    flat = np.arange(10_000, dtype=np.float32)
    tied, turned = View(flat, 0, (10_000,), (1,)), View(flat, 0, (100, 100), (1, 100))
    for loaded in load(tmp_path, saved({"a": tied, "b": tied, "c": turned}, legacy=legacy)).values():
        np.testing.assert_array_equal(loaded.ravel("F"), flat)
    for views in (1000 * [tied], [View(*turned) for _ in range(1000)]):
        many = {str(i): view for i, view in enumerate(views)}
        assert "larger than the file" in frugal_refusal(tmp_path, saved(many, legacy=legacy))


def test_files_of_python_2_are_read(tmp_path):
    content, raw = state_dict(arrays(), legacy=False)
    loaded = load(tmp_path, zip_file(re.sub(rb"X(.)\0\0\0", rb"U\1", content, flags=re.DOTALL), raw))
    assert list(loaded) == list(arrays())
    assert load(tmp_path, zip_file(b"\x80\x02ccollections\nOrderedDict\n]\x85R.", {})) == {}


class Payload:
    """Pickles as a call of os.system."""

    def __init__(self, command):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


@FORMATS
@pytest.mark.parametrize("protocol", [2, 4])
def test_code_is_reported_and_not_run(tmp_path, legacy, protocol):
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
def test_only_names_that_tensors_need_are_allowed(tmp_path, name):
    message = refusal(tmp_path, zip_file(b"\x80\x02c" + name.encode() + b"\n.", {}))
    assert name.replace("\n", ".") in message


def test_dotted_names_do_not_reach_into_allowed_classes(tmp_path):
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
def test_missing_or_truncated_storages_are_refused(tmp_path, legacy):
    tensors = {"a": np.zeros(4, np.float32), "b": np.zeros(3, np.float32)}
    content, raw = state_dict(tensors, legacy=legacy)
    assert set(load(tmp_path, WRAP[legacy](content, raw))) == {"a", "b"}
    refusal(tmp_path, WRAP[legacy](content, {"0": raw["0"]}))
    refusal(tmp_path, WRAP[legacy](content, raw | {"1": raw["1"][:-4]}))
    refusal(tmp_path, WRAP[legacy](state_dict(tensors, legacy=legacy, extra_elements=2**30)[0], raw))


@FORMATS
@pytest.mark.parametrize("content", GREEDY_PICKLES.values(), ids=GREEDY_PICKLES)
def test_little_memory_is_used_before_a_file_is_refused(tmp_path, legacy, content):
    frugal_refusal(tmp_path, WRAP[legacy](content, {}))


def test_nested_keys_do_not_exhaust_the_stack(tmp_path):
    refusal(tmp_path, zip_file(NESTED_KEY, {}))
    no_storages = pickle.dumps([], 2)
    sound = legacy_file(pickle.dumps({}, 2), {})
    refusal(tmp_path, sound.removesuffix(no_storages) + b"\x80\x02]" + NESTED_TUPLES + b"a.")


def test_overlapping_storages_are_refused(tmp_path):
    content, raw = state_dict({"a": np.zeros(2500), "b": np.zeros(2600)}, legacy=False)
    inner = zipfile.ZipInfo("saved/data/0")
    inner.CRC, inner.file_size, inner.compress_size = zlib.crc32(raw["0"]), len(raw["0"]), len(raw["0"])
    outer = (inner.FileHeader() + raw["0"]).ljust(len(raw["1"]), b"\0")
    stream = io.BytesIO(zip_file(content, {"1": outer}))
    with zipfile.ZipFile(stream, "a") as archive:
        inner.header_offset = stream.getvalue().index(outer)
        archive.filelist.append(inner)
        archive.comment = b"so that the list of entries is written again"
    refusal(tmp_path, stream.getvalue())


@FORMATS
@pytest.mark.parametrize(
    "value", [[], 3, {"epoch": 3}, {"model": {}}, {1: 2}], ids=["list", "number", "counter", "nested", "keys"]
)
def test_anything_but_a_dictionary_of_tensors_is_refused(tmp_path, legacy, value):
    assert "dictionary of tensors" in refusal(tmp_path, WRAP[legacy](pickle.dumps(value, 2), {}))


def test_big_endian_and_compressed_files_are_refused(tmp_path):
    content, raw = state_dict({"a": np.zeros(2, np.float32)}, legacy=False)
    assert "big-endian" in refusal(tmp_path, zip_file(content, raw, byteorder=b"big"))
    assert "compressed" in refusal(tmp_path, zip_file(content, raw, compression=zipfile.ZIP_DEFLATED))
    content, raw = state_dict({"a": np.zeros(2, np.float32)}, legacy=True)
    assert "big-endian" in refusal(tmp_path, legacy_file(content, raw, little_endian=False))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"weights", b"\x80\x02.", pickle.dumps(0, 2)])
def test_other_files_are_refused(tmp_path, content):
    refusal(tmp_path, content)


def test_missing_files_and_folders_are_refused(tmp_path):
    for path in (tmp_path / "nonsuch.pth", tmp_path):
        with pytest.raises(UserError, match="cannot be read"):
            torch_pickle.load(path)


def assert_mutations_are_harmless(folder, count, seed):
    sound = [saved(arrays(), legacy=legacy) for legacy in (False, True)]
    unsound_files.assert_mutations_are_harmless(torch_pickle.load, folder, sound, count, seed)


def test_mutated_files_are_harmless(tmp_path):
    assert_mutations_are_harmless(tmp_path, 300, 0)


@pytest.mark.slow
def test_many_mutated_files_are_harmless(tmp_path):
    assert_mutations_are_harmless(tmp_path, 5000, 1)
