"""Files that are written whole or not at all."""

import pytest

from l2dgs_jax.errors import UserError
from l2dgs_jax.files import replacing


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")

    class PowerCutError(Exception):
        pass

    def cut():
        with replacing(path) as temporary:
            temporary.write_text("half of the n")
            raise PowerCutError

    with pytest.raises(PowerCutError):
        cut()
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["file.txt"]
    with replacing(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new"


def test_a_file_that_cannot_take_its_place_is_a_clear_error_and_leaves_nothing_behind(tmp_path):
    path = tmp_path / "file.txt"

    def fill_the_disk():
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise OSError(28, "No space left on device")

    with pytest.raises(UserError, match=r"file\.txt: cannot be written \(No space left on device\)"):
        fill_the_disk()
    assert not list(tmp_path.iterdir())
