"""The page that shows methods side by side in a browser."""

import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import browser
import numpy as np
import pytest

from experiments import comparison
from experiments.comparison import _url
from experiments.web_page import write_page
from l2dgs_jax.errors import UserError
from l2dgs_jax.study import report
from l2dgs_jax.types import Camera

TEMPLATE = Path(comparison.__file__).with_suffix(".html")


def member(name, variant="a", seed=0, level=1.0, ended="finished"):
    varied = {"seed": seed, "loss.exposure_level": level}
    return {"name": name, "scene": "/data/mochi", "variant": variant, "varied": varied, "ended": ended}


@pytest.fixture
def study(tmp_path):
    def write(*members):
        (tmp_path / report.JSON).write_text(json.dumps({"members": members}))
        return tmp_path

    return write


def test_every_member_of_the_first_seed_has_its_own_pictures(study, monkeypatch):
    flat = lambda grey: np.full((3, 6, 8, 3), grey, np.float32)
    cameras = Camera(np.zeros((3, 4, 4)), np.zeros((3, 3, 3)), np.array([0.5, 0.0, 1.0]))
    split = SimpleNamespace(cameras=cameras, images=flat(0.1), welllit=flat(0.9))

    def views(run, cameras):
        for picture in flat(run.grey)[: len(cameras.time)]:
            yield SimpleNamespace(images=SimpleNamespace(welllit=picture))

    monkeypatch.setattr(comparison, "views", views)
    opened = lambda path: SimpleNamespace(grey=0.2 + 0.1 * int(path.name), dataset=SimpleNamespace(test=split))
    monkeypatch.setattr(comparison, "open_run", opened)
    members = [
        member("00"),
        member("01", level=2.0),
        member("02", variant="b"),
        member("03", variant="c", ended="diverged at step 7"),
        member("04", seed=1),
    ]
    folder = study(*members)
    comparison.main([str(folder), str(folder / "page.html"), "--views", "2"])
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', (folder / "page.html").read_text())
    (scene,) = json.loads(data[1])
    ours = ["a, loss.exposure_level 1.0", "a, loss.exposure_level 2.0", "b", "c (diverged at step 7)"]
    assert list(scene["pictures"]) == ["input", *ours, "truth"]
    assert len({tuple(pictures) for pictures in scene["pictures"].values()}) == len(scene["pictures"])
    assert (scene["times"], scene["size"]) == ([0.0, 1.0], [8, 6])


@pytest.mark.parametrize("name", ["input", "truth"])
def test_variants_named_like_other_pictures_are_refused(study, name):
    folder = study(member("00", variant=name))
    with pytest.raises(UserError, match=rf"results\.json: a variant is called '{name}'"):
        comparison.main([str(folder), str(folder / "page.html")])


@pytest.mark.parametrize(
    ("results", "arguments", "naming"),
    [
        (None, [], r"results\.json: no such file"),
        ('{"members": [', [], r"results\.json: cannot be read as JSON"),
        ("{}", [], r"results\.json: 'members' is missing"),
        ('{"members": []}', [], r"results\.json: its members"),
        ('{"members": [{"name": "00"}]}', [], r"results\.json: its members"),
        (None, ["--views", "0"], "--views 0"),
        (None, ["--views", "-1"], "--views -1"),
    ],
)
def test_mistakes_are_refused(tmp_path, results, arguments, naming):
    if results is not None:
        (tmp_path / report.JSON).write_text(results)
    with pytest.raises(UserError, match=naming):
        comparison.main([str(tmp_path), str(tmp_path / "page.html"), *arguments])


@pytest.mark.parametrize("output", ["no/page.html", ""])
def test_an_output_that_cannot_be_written_is_refused_before_rendering(study, output):
    folder = study(member("missing"))
    with pytest.raises(UserError, match="expected a file in an existing folder"):
        comparison.main([str(folder), str(folder / output)])


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("chromium"), reason="no browser")
def test_time_curtain_and_enlargement_follow_the_controls(tmp_path):
    flat = lambda grey: _url(np.full((30, 40, 3), grey, np.uint8))
    pictures = {name: [flat(20 * k), flat(20 * k + 9)] for k, name in enumerate(("input", "a", "b", "truth"))}
    scenes = [
        {"name": name, "size": (40, 30), "times": [0.0, 0.5], "pictures": pictures} for name in ("x", "</script>")
    ]
    write_page(tmp_path / "page.html", TEMPLATE, scenes)
    script = """
    const section = document.querySelectorAll("section")[1];
    const look = () => ({
      clock: section.querySelector("output").textContent,
      whole: [...section.querySelectorAll(".whole img")].map(image => image.src),
      left: section.querySelector(".over").src, right: section.querySelector(".curtain img:not(.over)").src,
      edge: section.querySelector(".curtain").style.getPropertyValue("--at"),
      crop: section.querySelector(".crop").style.backgroundPosition,
    });
    const turn = (control, value) => { control.value = value; control.dispatchEvent(new Event("input")); };
    const before = look(), [left, right] = section.querySelectorAll("select");
    turn(section.querySelector("[aria-label=time]"), 1);
    turn(section.querySelector("[aria-label=curtain]"), 20);
    turn(left, "input");
    turn(right, "b");
    const image = section.querySelector(".whole img"), box = image.getBoundingClientRect();
    const x = Math.round(box.left + .3 * box.width);  // a mouse knows whole pixels only
    image.dispatchEvent(new MouseEvent("click", {clientX: x, clientY: box.top + box.height}));
    const headings = [...document.querySelectorAll("h2")].map(heading => heading.textContent);
    return {before, after: look(), part: (x - box.left) / box.width, headings};
    """
    found = browser.result_of(tmp_path / "page.html", script, tmp_path)
    assert found["headings"] == ["x", "</script>"]
    first, second = ([urls[k] for urls in pictures.values()] for k in (0, 1))
    before, after = found["before"], found["after"]
    assert (before["clock"], before["whole"], before["left"], before["right"]) == (
        "time 0.00",
        first,
        first[1],
        first[3],
    )
    assert (after["clock"], after["whole"], after["left"], after["right"]) == (
        "time 0.50",
        second,
        second[0],
        second[2],
    )
    assert (before["edge"], after["edge"]) == ("50%", "20%")
    assert before["crop"] == "50% 50%"
    crop = [float(part.strip("%")) for part in after["crop"].split()]
    assert crop == pytest.approx(
        [100 * (found["part"] - 0.1) / 0.8, 100], abs=0.01
    )  # a fifth is shown, a tenth to the left
