"""The user study: its page, the table of its answers, and what is refused."""

import json
import re
import shutil

import browser
import numpy as np
import pytest

from experiments import user_study
from experiments.user_study import CRITERIA, aggregate, markdown
from l2dgs_jax.data.images import write_image
from l2dgs_jax.errors import UserError

KEY = {
    "study": "night-0",
    "methods": ["ours", "theirs"],
    "key": {"Scene 1": {"A": "ours", "B": "theirs"}, "Scene 2": {"A": "theirs", "B": "ours"}},
}


def answer(scene, criterion, best=None, **ratings):
    return {"scene": scene, "criterion": criterion} | ({"best": best} if best else {}) | {"ratings": ratings}


def person(tmp_path, name, *answers, study="night-0"):
    return tmp_path / f"{name}.json", {"study": study, "participant": name, "answers": list(answers)}


def test_letters_are_assigned_to_methods_anew_for_every_scene(tmp_path):
    """Choosing A everywhere is no preference: the letter stands for another method in each scene."""
    people = dict([person(tmp_path, "one", answer("Scene 1", 0, "A", A=5, B=2), answer("Scene 2", 0, "A", A=4, B=1))])
    found = aggregate(KEY, people)
    assert [found["chosen"][method][0]["value"] for method in KEY["methods"]] == [50, 50]
    assert [found["rating"][method][0]["value"] for method in KEY["methods"]] == [3, 3]
    assert found["chosen"]["ours"][1] is None, "nobody answered by that criterion"


def test_shares_and_intervals_are_over_participants(tmp_path):
    """Two of three people prefer ours throughout; their many answers count as two people, not as many."""
    both = [answer(scene, 0, best) for scene, best in (("Scene 1", "A"), ("Scene 2", "B"))]
    neither = [answer(scene, 0, best) for scene, best in (("Scene 1", "B"), ("Scene 2", "A"))]
    people = dict(person(tmp_path, name, *given) for name, given in (("a", both), ("b", both), ("c", neither)))
    cell = aggregate(KEY, people)["chosen"]["ours"][0]
    assert cell["value"] == pytest.approx(200 / 3)
    assert (cell["low"], cell["high"]) == (0, 100)
    many = dict(
        person(tmp_path, f"{name}{i}", *given) for i in range(60) for name, given in (("a", both), ("c", neither))
    )
    wide = aggregate(KEY, many)["chosen"]["ours"][0]
    # 1.96 standard deviations of a mean of 120 people, half of whom say 100
    assert wide["high"] - wide["low"] == pytest.approx(2 * 1.96 * 50 / np.sqrt(120), rel=0.15)


def test_the_table_has_the_form_of_table_2(tmp_path):
    people = dict([person(tmp_path, "one", *(answer("Scene 1", c, "A", A=5, B=2) for c in range(5)))])
    lines = markdown(aggregate(KEY, people)).splitlines()
    assert lines[0].strip("| ").split(" | ") == [f"Criterion ({numeral})" for numeral in ("i", "ii", "iii", "iv", "v")]
    assert lines[2].startswith("| ours | 100.0 [100.0, 100.0] / 5.00 [5.00, 5.00] |")
    assert lines[-3].startswith("| paper: L2DGS | 75.2 / 4.05 | 93.6 / 4.33 |")
    assert lines[-1].startswith("1 participants; in brackets 95%, bootstrap over participants")


@pytest.mark.parametrize(
    ("given", "naming"),
    [
        ({"study": "other-1"}, "other-1"),
        ({"answers": [answer("Scene 3", 0, "A")]}, "does not offer"),
        ({"answers": [answer("Scene 1", 5, "A")]}, "does not offer"),
        ({"answers": [answer("Scene 1", -1, "A")]}, "does not offer"),
        ({"answers": [answer("Scene 1", 0, "A"), answer("Scene 1", 0, "A")]}, "does not offer"),
        ({"answers": [answer("Scene 1", 0, "C")]}, "does not offer"),
        ({"answers": [answer("Scene 1", 0, A=6)]}, "does not offer"),
        ({"answers": [answer("Scene 1", 0, A=2.5)]}, "does not offer"),
        ({"answers": 3}, "does not offer"),
        ({"answers": [{**answer("Scene 1", 0), "ratings": [1, 2]}]}, "does not offer"),
        ({"participant": None}, "does not offer"),
    ],
)
def test_answers_to_something_else_are_refused(tmp_path, given, naming):
    path, content = person(tmp_path, "one", answer("Scene 1", 0, "A"))
    with pytest.raises(UserError, match=r"one\.json") as caught:
        aggregate(KEY, {path: content | given})
    assert naming in str(caught.value)


def test_answers_of_one_participant_in_two_files_are_refused(tmp_path):
    path, content = person(tmp_path, "one", answer("Scene 1", 0, "A"))
    with pytest.raises(UserError, match="'one' has given several"):
        aggregate(KEY, {path: content, tmp_path / "again.json": content})


def media(folder, methods=("ours", "theirs", "input"), scenes=("moose", "otter", "zebra")):
    for shade, method in enumerate(methods):
        (folder / method).mkdir(parents=True)
        for scene in scenes:
            write_image(folder / method / f"{scene}.png", np.full((8, 12, 3), 60 * shade, np.uint8))
    return folder


def test_a_page_is_blind_and_its_order_comes_from_the_seed(tmp_path):
    folder = media(tmp_path / "media")
    pages = {}
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        user_study.main(["page", str(folder), str(tmp_path / f"{name}.html"), "--seed", str(seed)])
        pages[name] = json.loads((tmp_path / f"{name}.key.json").read_text())["key"]
    assert pages["a"] == pages["b"] != pages["c"]
    assert all(set(dealt.values()) == {"ours", "theirs"} for dealt in pages["a"].values())
    page = (tmp_path / "a.html").read_text()
    shown = re.sub(r'data:[^"]*', "", page)  # encoded pictures may spell anything
    assert not [word for word in ("ours", "theirs", "moose", "otter", "zebra") if word in shown]
    assert "http" not in page


def test_a_page_that_may_have_been_answered_is_not_overwritten(tmp_path):
    folder = media(tmp_path / "media")
    user_study.main(["page", str(folder), str(tmp_path / "a.html")])
    (tmp_path / "a.html").unlink()
    with pytest.raises(UserError, match=r"a\.key\.json"):
        user_study.main(["page", str(folder), str(tmp_path / "a.html"), "--seed", "1"])
    assert not (tmp_path / "a.html").exists()


def test_a_page_and_its_key_are_written_together_or_not_at_all(tmp_path):
    folder = media(tmp_path / "media")
    for name, blocked in (("a", "a.key.json"), ("b", "b.html")):
        (tmp_path / blocked).mkdir()
        with pytest.raises(UserError, match=blocked):
            user_study.main(["page", str(folder), str(tmp_path / f"{name}.html")])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.key.json", "b.html", "media"]
    (tmp_path / "a.key.json").rmdir()
    user_study.main(["page", str(folder), str(tmp_path / "a.html")])


@pytest.mark.parametrize("change", [{"study": 0}, {"methods": None}, {"key": []}])
def test_malformed_keys_and_answers_are_refused(tmp_path, change):
    path, answers = person(tmp_path, "one", answer("Scene 1", 0, "A"))
    for file, content in ((path, answers), (tmp_path / "key.json", KEY | change)):
        file.write_text(json.dumps(content))
        with pytest.raises(UserError, match=rf"{file.name}: '(methods|{next(iter(change))})'"):
            user_study.main(["table", str(file), str(path)])


@pytest.mark.parametrize(
    ("change", "naming"),
    [
        (lambda folder: shutil.rmtree(folder / "theirs"), "two methods"),
        (lambda folder: (folder / "theirs" / "otter.png").unlink(), "has no otter"),
        (lambda folder: shutil.copy(folder / "theirs" / "otter.png", folder / "theirs" / "otter.jpg"), "one file per"),
        (lambda folder: [path.rename(path.with_suffix(".txt")) for path in folder.glob("*/*.png")], "no pictures"),
    ],
)
def test_a_folder_unsuitable_for_a_study_is_refused(tmp_path, change, naming):
    change(folder := media(tmp_path / "media"))
    with pytest.raises(UserError, match=naming):
        user_study.main(["page", str(folder), str(tmp_path / "out.html")])
    assert not (tmp_path / "out.html").exists()


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("chromium"), reason="no browser")
def test_clicks_are_counted_as_answers(tmp_path):
    """The judge always prefers black pictures, those of the method `ours`, and rates them 4."""
    user_study.main(["page", str(media(tmp_path / "media")), str(tmp_path / "night.html"), "--seed", "3"])
    script = """
    const black = image => {
      const pen = document.createElement("canvas").getContext("2d");
      pen.drawImage(image, 0, 0);
      return pen.getImageData(1, 1, 1, 1).data[0] === 0;
    };
    document.getElementById("participant").value = " judge ";
    for (const section of document.querySelectorAll("section")) {
      const best = [...section.querySelectorAll("figure")].find(f => black(f.querySelector("img"))).textContent;
      for (const radio of section.querySelectorAll(`input[value="${best}"]`)) radio.click();
      for (const select of section.querySelectorAll("select")) select.value = select.name.endsWith(best) ? 4 : 2;
    }
    follow();
    return {content: content(), progress: document.getElementById("progress").textContent,
            kept: JSON.parse(localStorage.getItem(study))};
    """
    found = browser.result_of(tmp_path / "night.html", script, tmp_path)
    assert found["progress"] == "45 of 45 answered"
    assert found["content"] == found["kept"]
    assert found["content"]["participant"] == "judge"
    key = json.loads((tmp_path / "night.key.json").read_text())
    table = aggregate(key, {tmp_path / "judge.json": found["content"]})
    for criterion in range(len(CRITERIA)):
        assert table["chosen"]["ours"][criterion]["value"] == 100
        assert [table["rating"][m][criterion]["value"] for m in ("ours", "theirs")] == [4, 2]
