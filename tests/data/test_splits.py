"""Which frames are held out, and the instants of frames."""

import numpy as np
import pytest
from scenes import write_json

from l2dgs_jax.data import splits
from l2dgs_jax.errors import UserError

NAMES = [f"{i:02d}" for i in range(17)]


def test_held_out_rules():
    rule = lambda name: splits.hold_out("x", NAMES, splits.NO_LISTS, name, "8")
    assert rule("auto") == rule("8") == ([n for i, n in enumerate(NAMES) if i % 8], ["00", "08", "16"], ())
    note = "9 of 17 frames are used (held-out rule 4dgs)"
    assert rule("4dgs") == (["00", "04", "08", "12", "16"], ["02", "06", "10", "14"], (note,))


def test_the_scenes_own_lists_are_used_unless_a_rule_is_given():
    own = (["03", "01"], ["02"])
    assert splits.hold_out("x", NAMES, own, "auto", "8") == (*own, ())
    assert splits.hold_out("x", NAMES, own, "9", "8")[1] == ["00", "09"]


@pytest.mark.parametrize("names", [[], ["a"], ["a", "b"]])
def test_too_few_frames_are_refused(names):
    with pytest.raises(UserError, match=f"x: .* held out, of {len(names)} listed; expected at least"):
        splits.hold_out("x", names, splits.NO_LISTS, "auto", "8")


@pytest.mark.parametrize("rule", ["", "1", "0", "-3", "every", "2.5", "9" * 30])
def test_unknown_rules_are_refused(rule):
    with pytest.raises(UserError, match=f"--held-out {rule}: expected auto, 4dgs"):
        splits.check_rule(rule)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["f_001", "f_002", "f_005"], [0, 0.25, 1]),  # by number, as frames may be missing
        (["left_1", "left_3", "right_1", "right_3"], [0, 1, 0, 1]),  # two cameras at the same instants
        (["a9_10.5", "a9_10.7"], [0, 1]),
        (["0000_0", "0000_1", "0001_0", "0001_1", "0004_0"], [0, 0, 0.25, 0.25, 1]),  # numbers of cameras at the end
        (["0_cam0", "3_cam0", "6_cam1"], [0, 0.5, 1]),
        ([f"cam{i:02d}/{j}" for i in range(3) for j in (4, 8)], [0, 1] * 3),  # more cameras than instants
        ([f"t{j}_c{i}" for i in range(3) for j in (4, 8)], [0, 1] * 3),
        (["cam_1", "cam_2", "cam_5"], [0, 0.25, 1]),  # no camera's number, as no other differs
        (["take7", "take7b", "take7c"], [0, 0.5, 1]),  # all have the same number: by order
        (["1", "2", "x"], [0, 0.5, 1]),  # not all have a number: by order
        (["only"], [0]),
        (["1305.98", "1306.02", "1306.06"], [0, 0.5, 1]),  # seconds with fractions
        (["t1.5", "t1.75", "t2.0"], [0, 0.5, 1]),
        (["s1.9", "s1.10", "s1.11"], [0, 0.5, 1]),  # the tenth of part 1
        (["0_a81f", "1_b20d", "3_e9"], [0, 1 / 3, 1]),  # hashes behind
        (["a81f_0", "b20d_1", "e9_3"], [0, 1 / 3, 1]),
        (["0_7300", "1_7340", "2_7400"], [0, 0.4, 1]),  # numbers and times
    ],
)
def test_instants_from_names(tmp_path, names, expected):
    np.testing.assert_allclose(list(splits.instants(tmp_path, names).values()), expected)


def test_instants_from_metadata(tmp_path):
    instants = lambda *entries: [
        write_json(tmp_path / "metadata.json", dict(zip("abc", entries, strict=True))),
        list(splits.instants(tmp_path, ["a", "b", "c"]).values()),
    ][1]
    assert instants(*({"time": t, "warp_id": 9} for t in (0.25, 0.5, 0.75))) == [0.25, 0.5, 0.75]
    assert instants(*({"time": t} for t in (10, 20, 60))) == [0, 0.2, 1]  # e.g. seconds
    assert instants(*({"warp_id": t} for t in (1, 2, 5))) == [0, 0.25, 1]
    assert instants(*({"time_id": t} for t in (5, 1, 2))) == [1, 0, 0.25]
    assert instants({}, {}, {}) == [0, 0.5, 1]
    write_json(tmp_path / "metadata.json", {"somebody": "else's"})
    assert list(splits.instants(tmp_path, ["a", "b"]).values()) == [0, 1]


def test_frames_that_are_listed_twice_are_only_held_out():
    names = [f"{i}" for i in range(6)]
    train, test, notes = splits.hold_out("lists", names, (["0", "1", "2", "2", "3"], ["3", "5", "5"]), "auto", "8")
    assert (train, test) == (["0", "1", "2"], ["3", "5"])
    assert notes == ("lists: 1 frames are listed in both ways; they are held out",)
    train, test, notes = splits.hold_out("lists", names, (names, names), "auto", "8")
    assert train == test == names
    assert "also trained on" in notes[0]


def test_all_but_the_frames_held_out_are_trained_on(tmp_path):
    write_json(tmp_path / "dataset.json", {"val_ids": ["b"]})
    assert splits.lists_beside(tmp_path, ["a", "b", "c"]) == (["a", "c"], ["b"])
    write_json(tmp_path / "dataset.json", {"ids": ["a", "b", "c"], "val_ids": ["b"]})
    assert splits.lists(tmp_path) == (["a", "b", "c"], (["a", "c"], ["b"]))
