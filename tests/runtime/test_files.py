"""Files and folders that are written whole or not at all."""

import errno
import json
import os
from pathlib import Path

import pytest

from l2dgs_jax.errors import DISK_FULL, UserError
from l2dgs_jax.runtime.files import append_line, is_writable, new_folder, replacing, takes_file, write_json


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


def test_a_file_that_cannot_be_written_is_reported_and_leaves_nothing_behind(tmp_path):
    path = tmp_path / "file.txt"

    def fill_the_disk():
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise OSError(28, "No space left on device")

    with pytest.raises(UserError, match=r"file\.txt: cannot be written \(No space left on device\); .* room"):
        fill_the_disk()
    assert not list(tmp_path.iterdir())


def test_a_link_stays_one_and_what_is_no_file_stays_what_it_is(tmp_path):
    (tmp_path / "target").write_text("old")
    (tmp_path / "link.txt").symlink_to("target")
    with replacing(tmp_path / "link.txt") as temporary:
        assert temporary.suffix == ".txt"
        temporary.write_text("new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "target").read_text() == "new"
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="pipe: is a device; expected a file"), replacing(tmp_path / "pipe"):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.txt", "pipe", "target"]
    assert (tmp_path / "pipe").is_fifo()


def test_a_folder_that_takes_no_files_is_noticed_before_the_work(monkeypatch, tmp_path):
    def refuse(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "touch", refuse)
    begun = False
    with pytest.raises(UserError, match=r"a\.txt: cannot be written"), replacing(tmp_path / "a.txt"):
        begun = True
    assert not begun


def test_files_can_be_created_in_folders_that_are_missing_but_not_below_files(tmp_path):
    (tmp_path / "file").write_text("")
    assert is_writable(tmp_path)
    assert is_writable(tmp_path / "new" / "newer")
    assert not is_writable(tmp_path / "file")
    assert not is_writable(tmp_path / "file" / "new")


def test_a_file_needs_a_folder_that_can_be_written_to(tmp_path, monkeypatch):
    (tmp_path / "old.json").write_text("")
    assert takes_file(tmp_path / "new.json")
    assert takes_file(tmp_path / "old.json")
    assert not takes_file(tmp_path)
    assert not takes_file(tmp_path / "missing" / "new.json")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert not takes_file(tmp_path / "new.json")


def test_a_name_that_is_too_long_is_reported_in_one_sentence(tmp_path):
    with pytest.raises(UserError, match="cannot be written"), replacing(tmp_path / f"{'x' * 300}.txt"):
        pass


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    def fill(path, then=None):
        with new_folder(path) as temporary:
            (temporary / "a.txt").write_text("a")
            assert not path.exists() or not list(path.iterdir())
            if then:
                raise then

    for error, raised in ((KeyError("x"), KeyError), (OSError(28, "No space left on device"), UserError)):
        with pytest.raises(raised) as caught:
            fill(tmp_path / "new", error)
        assert not list(tmp_path.iterdir())
    assert caught.value.code == DISK_FULL
    (tmp_path / "empty").mkdir()
    for name in ("new", "deep/er", "empty"):
        fill(tmp_path / name)
        assert [path.name for path in (tmp_path / name).iterdir()] == ["a.txt"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deep", "empty", "new"]


def test_a_new_folder_replaces_nothing(tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "full")
    (tmp_path / "file").write_text("")
    for name in ("full", "link", "file"):
        with (
            pytest.raises(UserError, match=f"{name}: exists already; expected a new or an empty folder"),
            new_folder(tmp_path / name),
        ):
            raise AssertionError("entered")


@pytest.mark.parametrize("exists", [True, False])
def test_a_new_folder_is_made_where_a_link_leads(tmp_path, exists):
    place, link = tmp_path / "place", tmp_path / "link"
    if exists:
        place.mkdir()
    link.symlink_to(place)
    with new_folder(link) as temporary:
        (temporary / "a.txt").write_text("a")
    assert link.is_symlink()
    assert (place / "a.txt").is_file()


def test_a_line_that_cannot_be_added_is_reported_in_one_sentence(tmp_path):
    append_line(tmp_path / "lines", "a")
    append_line(tmp_path / "lines", "b")
    assert (tmp_path / "lines").read_text() == "a\nb\n"
    with pytest.raises(UserError, match=r"nonsuch/lines: cannot be written \(No such file or directory\); expected"):
        append_line(tmp_path / "nonsuch" / "lines", "a")


def test_json_has_strings_for_infinity_and_nan(tmp_path):
    refuse = lambda name: pytest.fail(f"{name} is no JSON")
    infinite = float("inf")
    write_json(tmp_path / "scores.json", {"psnr": infinite, "regions": [{"psnr": -infinite}, (float("nan"), 1.5)]})
    read = json.loads((tmp_path / "scores.json").read_text(), parse_constant=refuse)
    assert read == {"psnr": "Infinity", "regions": [{"psnr": "-Infinity"}, ["NaN", 1.5]]}
    assert float(read["psnr"]) == infinite
