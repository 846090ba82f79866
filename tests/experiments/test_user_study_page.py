"""The page of the user study: what it shows and hides, and how it behaves in a browser."""

import base64
import contextlib
import json
import re
import shutil

import browser
import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest

from experiments import user_study
from experiments.user_study_statistics import CRITERIA, aggregate
from l2dgs_jax.data.images import read_image, write_image
from l2dgs_jax.errors import UserError
from l2dgs_jax.visualize.video import open_video, video_path


def media(folder, methods=("ours", "theirs", "input"), scenes=("moose", "otter", "zebra")):
    for shade, method in enumerate(methods):
        (folder / method).mkdir(parents=True)
        for scene in scenes:
            write_image(folder / method / f"{scene}.png", np.full((8, 12, 3), 60 * shade, np.uint8))
    return folder


def made(folder, name, *options):
    """The page's data, and its key."""
    user_study.main(["page", str(folder), str(folder.parent / f"{name}.html"), *options])
    page = (folder.parent / f"{name}.html").read_text()
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', page)[1]
    return json.loads(data), json.loads((folder.parent / f"{name}.key.json").read_text())


def test_the_letters_come_from_the_seed_and_the_key_says_what_was_shown(tmp_path):
    folder = media(tmp_path / "media")
    keys = [made(folder, name, "--seed", seed)[1] for name, seed in (("a", "0"), ("b", "0"), ("c", "1"))]
    dealt = [[scene["letters"] for scene in key["scenes"].values()] for key in keys]
    assert dealt[0] == dealt[1] != dealt[2]
    assert all(set(letters.values()) == {"ours", "theirs"} for letters in dealt[0])
    assert (keys[2]["seed"], keys[2]["kind"]) == (1, "both")
    assert [scene["name"] for scene in keys[2]["scenes"].values()] == ["moose", "otter", "zebra"]


def test_a_study_is_told_by_all_that_its_page_shows(tmp_path):
    """Pages of one name, of which answers to one must not be taken for answers to another."""

    def study(name, change=lambda folder: None, *options):
        change(folder := media(tmp_path / name / "media"))
        data, key = made(folder, "night", *options)
        assert data["study"] == key["study"]
        return key["study"]

    usual = study("usual")
    others = [
        study("kind", lambda folder: None, "--kind", "rating"),
        study("pixels", lambda folder: write_image(folder / "ours" / "otter.png", np.full((8, 12, 3), 9, np.uint8))),
        study("input", lambda folder: shutil.rmtree(folder / "input")),
        study("scene", lambda folder: [path.rename(path.with_stem("seal")) for path in folder.glob("*/otter.png")]),
        study("letters", lambda folder: None, "--seed", "1"),
    ]
    assert study("again") == usual
    assert len({usual, *others}) == 6


def test_a_page_is_blind(tmp_path):
    """Neither its text nor its pictures tell methods apart, though theirs are JPEG files and ours say so."""
    folder = media(tmp_path / "media")
    for path in folder.glob("ours/*.png"):
        picture = oiio.ImageBuf(str(path))
        for name in ("ImageDescription", "Software"):
            picture.specmod().attribute(name, "made by ours")
        picture.write(str(path))
        assert b"made by ours" in path.read_bytes()
    for path in folder.glob("theirs/*.png"):
        write_image(path.with_suffix(".jpg"), np.full((8, 12, 3), 60, np.uint8))
        path.unlink()
    data, key = made(folder, "night")
    pictures = [shown for scene in data["scenes"] for shown in scene["media"].values()]
    text = re.sub(r'data:[^"]*', "", (tmp_path / "night.html").read_text())  # encoded pictures may spell anything
    assert not [word for word in ("ours", "theirs", "moose", "otter", "zebra", "http") if word in text]
    contents = [base64.b64decode(shown.removeprefix("data:image/png;base64,"), validate=True) for shown in pictures]
    assert len({tuple(chunks(content)) for content in contents}) == 1
    assert not {b"tEXt", b"zTXt", b"iTXt", b"tIME"} & {name for name, _ in chunks(contents[0])}
    for scene in data["scenes"]:
        for letter, method in key["scenes"][scene["name"]]["letters"].items():
            (tmp_path / "shown.png").write_bytes(base64.b64decode(scene["media"][letter].partition(",")[2]))
            original = next((folder / method).glob(f"{key['scenes'][scene['name']]['name']}.*"))
            np.testing.assert_array_equal(read_image(tmp_path / "shown.png"), read_image(original))


def chunks(content):
    """Names of a PNG file's chunks, and what is in them apart from the pixels."""
    at = 8
    while at < len(content):
        size, name = int.from_bytes(content[at : at + 4], "big"), content[at + 4 : at + 8]
        yield name, b"" if name == b"IDAT" else content[at + 8 : at + 8 + size]
        at += 12 + size


def film(stem, size=(16, 8)):
    with open_video(stem, size, 10) as add:
        for shade in (0, 90):
            add(np.full((size[1], size[0], 3), shade, np.uint8))
    return video_path(stem)


def test_videos_are_shown_as_they_are(tmp_path):
    for method in ("ours", "theirs"):
        (tmp_path / "media" / method).mkdir(parents=True)
        path = film(tmp_path / "media" / method / "moose")
    data, _ = made(tmp_path / "media", "night")
    assert base64.b64decode(data["scenes"][0]["media"]["A"].partition(",")[2]) == path.read_bytes()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda path: film(path.with_suffix(""), (16, 12)), "16x12 pixels; expected a {} video of 16x8 "),
        (lambda path: path.rename(path.with_suffix(".webm" if path.suffix == ".mp4" else ".mp4")), "a {} video "),
        (lambda path: write_image(path.rename(path.with_suffix(".png")), np.zeros((8, 16, 3), np.uint8)), "a picture "),
        (lambda path: path.write_bytes(b"junk"), "not a video"),
    ],
)
def test_videos_that_could_be_told_apart_by_their_files_are_refused(tmp_path, change, expected):
    for method in ("ours", "theirs"):
        (tmp_path / "media" / method).mkdir(parents=True)
        path = film(tmp_path / "media" / method / "moose")
    change(path)
    with pytest.raises(UserError, match=expected.format(path.suffix)) as caught:
        made(tmp_path / "media", "night")
    if "not a video" not in expected:
        assert all(str(tmp_path / "media" / method / "moose") in str(caught.value) for method in ("ours", "theirs"))


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


@pytest.mark.parametrize(
    ("change", "naming"),
    [
        (lambda folder: shutil.rmtree(folder / "theirs"), "two methods"),
        (lambda folder: (folder / "theirs" / "otter.png").unlink(), "has no otter"),
        (lambda folder: shutil.copy(folder / "theirs" / "otter.png", folder / "theirs" / "otter.jpg"), "one file per"),
        (
            lambda folder: write_image(folder / "theirs" / "otter.png", np.zeros((9, 12, 3), np.uint8)),
            r"theirs.otter\.png: .*12x9 pixels; expected .* 12x8 like .*(input|ours).otter\.png",
        ),
        (lambda folder: [path.rename(path.with_suffix(".txt")) for path in folder.glob("*/*.png")], "no pictures"),
    ],
)
def test_a_folder_unsuitable_for_a_study_is_refused(tmp_path, change, naming):
    change(folder := media(tmp_path / "media"))
    with pytest.raises(UserError, match=naming):
        user_study.main(["page", str(folder), str(tmp_path / "out.html")])
    assert not (tmp_path / "out.html").exists()


@pytest.fixture
def shown(tmp_path, chromium):
    """A page in a browser."""
    made(media(tmp_path / "media"), "night", "--seed", "3")
    with browser.opened((tmp_path / "night.html").as_uri(), tmp_path / "profile") as tab:
        page = tab()
        browser.awaited(lambda: page.says("location.href !== 'about:blank' && document.readyState === 'complete'"))
        yield page


def reload(shown):
    """In the same tab: what one tab keeps reaches another only after a while."""

    def loaded():
        with contextlib.suppress(AssertionError):  # if asked while the page is being left
            return shown.says("!window.left && document.readyState === 'complete'")

    shown.says("window.left = true; setTimeout(() => location.reload())")
    browser.awaited(loaded)


def best(scene, letter, criterion=0):
    """The button, in JavaScript."""
    return f"""document.querySelector('[name="{scene}/{criterion}/best"][value={letter}]')"""


def kept(shown):
    return shown.says("localStorage.getItem(study)")


@pytest.mark.slow
def test_clicks_are_counted_as_answers(shown, tmp_path):
    """The judge always prefers black pictures, those of the method `ours`, and rates them 4."""
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
    document.dispatchEvent(new Event("input"));
    const parts = [];
    Blob = class { constructor(content) { parts.push(...content); } };
    URL.createObjectURL = () => "#";
    document.getElementById("save").click();
    return {file: JSON.parse(parts[0]), progress: document.getElementById("progress").textContent};
    """
    found = shown.says(f"(() => {{ {script} }})()")
    assert found["progress"] == "45 of 45 answered"
    assert found["file"] == json.loads(kept(shown))
    assert found["file"]["participant"] == "judge"
    key = json.loads((tmp_path / "night.key.json").read_text())
    table = aggregate(key, {tmp_path / "judge.json": found["file"]})
    for criterion in range(len(CRITERIA)):
        assert table["chosen"]["ours"][criterion]["value"] == 100
        assert [table["rating"][m][criterion]["value"] for m in ("ours", "theirs")] == [4, 2]


@pytest.mark.slow
def test_answers_survive_leaving_the_page(shown):
    controls = "[...document.querySelectorAll('select, [type=radio]')].map(c => c.name + c.value + c.checked)"
    shown.says("participant.value = 'ann'; document.getElementsByName('s2/4/A')[0].value = 5")
    shown.says(f"{best('s1', 'B')}.click(); {best('s3', 'A', 2)}.click()")
    given, states = shown.says("content()"), shown.says(controls)
    assert given["answers"] == [
        {"scene": "s1", "criterion": 0, "best": "B"},
        {"scene": "s2", "criterion": 4, "ratings": {"A": 5}},
        {"scene": "s3", "criterion": 2, "best": "A"},
    ]
    reload(shown)
    assert shown.says("content()") == given
    assert shown.says(controls) == states


@pytest.mark.slow
def test_what_cannot_be_restored_is_left_as_it_is(shown):
    fitting = [{"scene": "s1", "criterion": 0, "best": "B"}, {"scene": "s2", "criterion": 1, "ratings": {"B": 3}}]
    misfits = [{"scene": "s9", "criterion": 0, "best": "A"}, {"scene": "s1", "criterion": 1, "ratings": {"A": 9}}, None]
    content = json.loads(kept(shown)) | {"answers": [misfits[0], fitting[0], *misfits[1:], fitting[1]]}
    for damaged, restored in ((json.dumps(content), fitting), ('{"id', []), ("3", [])):
        shown.says(f"localStorage.setItem(study, {json.dumps(damaged)})")
        reload(shown)
        assert shown.says("answers()") == restored
        shown.says(f"{best('s3', 'A')}.click()")
        assert shown.says("count()") == len(restored) + 1
        assert kept(shown) == damaged
        assert "this browser does not keep them" in shown.text()


@pytest.mark.slow
def test_participants_have_orders_of_their_own(shown):
    """Pictures and columns are in the same order, which depends on the browser's id alone."""
    script = """[...document.querySelectorAll("section")].map(section => [
      section.querySelector("h2").textContent,
      section.querySelector("select").name.split("/")[0],
      [...section.querySelectorAll("figcaption")].map(caption => caption.textContent).join(" "),
      ["input", ...section.querySelectorAll("thead th + th")].map(heading => heading.textContent ?? heading).join(" "),
      [...section.querySelectorAll("tbody tr:first-child input")].map(button => button.value).join(" "),
    ])"""
    first = shown.says(script)
    reload(shown)
    assert shown.says(script) == first, "a participant who returns"
    orders = []
    for number in range(6):
        content = {"id": f"{number:032x}"[::-1], "answers": []}
        shown.says(f"localStorage.setItem(study, {json.dumps(json.dumps(content))})")
        reload(shown)
        sections = shown.says(script)
        assert [heading for heading, *_ in sections] == [f"Scene {i} of 3" for i in (1, 2, 3)]
        assert sorted(scene for _, scene, *_ in sections) == ["s1", "s2", "s3"]
        for *_, pictures, columns, buttons in sections:
            assert pictures == columns == f"input {buttons}"
        orders.append([(scene, buttons) for _, scene, *_, buttons in sections])
    assert len({tuple(scene for scene, _ in order) for order in orders}) > 2
    assert {letters for order in orders for _, letters in order} == {"A B", "B A"}


@pytest.mark.slow
def test_a_second_click_withdraws_a_choice(shown):
    assert "click a choice again to withdraw it" in shown.text()
    for letter, chosen in (("A", ["A"]), ("B", ["B"]), ("B", []), ("B", ["B"]), ("A", ["A"])):
        shown.says(f"{best('s1', letter)}.click()")
        assert [answer["best"] for answer in shown.says("answers()")] == chosen
        assert shown.says("[...document.querySelectorAll(':checked[type=radio]')].map(b => b.value)") == chosen
        assert [answer["best"] for answer in json.loads(kept(shown))["answers"]] == chosen
        assert f"{len(chosen)} of 45 answered" in shown.text()


@pytest.mark.slow
def test_leaving_with_answers_that_are_in_no_file_is_warned_of(shown):
    """Also if they were given before the page was last opened."""
    asks = "!window.dispatchEvent(new Event('beforeunload', {cancelable: true}))"
    shown.says("participant.value = 'ann'; document.dispatchEvent(new Event('input'))")
    assert not shown.says(asks), "there are no answers"
    shown.says(f"{best('s1', 'A')}.click()")
    assert shown.says(asks)
    reload(shown)
    assert shown.says(asks)
    shown.says("HTMLAnchorElement.prototype.click = () => {}; document.getElementById('save').click()")
    assert not shown.says(asks)
    reload(shown)
    assert not shown.says(asks)
    shown.says(f"{best('s1', 'B')}.click()")
    assert shown.says(asks)
    shown.says(f"{best('s1', 'B')}.click()")
    assert not shown.says(asks), "the only answer is withdrawn"
