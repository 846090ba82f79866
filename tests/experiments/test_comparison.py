"""The page that shows methods side by side in a browser."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import browser
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import comparison
from experiments.comparison import _url
from experiments.web_page import write_page
from l2dgs_jax import runs
from l2dgs_jax.errors import UserError
from l2dgs_jax.study import report
from l2dgs_jax.types import Camera, Decomposition, RenderOutput

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

    def split(focal):
        cameras = Camera(np.zeros((3, 4, 4)), np.full((3, 3, 3), focal), np.array([0.5, 0.0, 1.0]))
        return SimpleNamespace(names=names.get(focal, "abc"), cameras=cameras, images=flat(0.1), welllit=flat(0.9))

    def views(run, cameras):
        """As bright as the run, and as far away as the points of its own world."""
        assert (run.number == cameras.K).all()
        for picture in flat(0.2 + 0.1 * run.number)[: len(cameras.time)]:
            ones, none = np.ones((6, 8), np.float32), np.zeros(0)
            images = Decomposition(*[picture] * 4, np.ones((6, 8, 2), np.float32))
            counters = none, np.zeros((), int), np.zeros((), bool)
            yield RenderOutput(*jax.tree.map(jnp.asarray, (images, ones, picture[..., 0], *counters)))

    def opened(path):
        number = int(path.name)
        train = SimpleNamespace(cameras=Camera(np.eye(4)[None], np.eye(3)[None], np.zeros(1)))
        points = np.array([[0.0, 0.0, 0.2 + 0.1 * number]])
        return SimpleNamespace(number=number, dataset=SimpleNamespace(train=train, test=split(number), points=points))

    names = {}
    monkeypatch.setattr(comparison, "views", views)
    monkeypatch.setattr(comparison, "open_run", opened)
    members = [
        member("00"),
        member("01", level=2.0),
        member("02", variant="b"),
        member("03", variant="c", ended="diverged at step 7"),
        member("04", seed=1),
    ]
    folder = study(*members)
    (folder / "02").mkdir()
    lines = [{"step": 1, "psnr": 20.0}, {"step": 2, "psnr": 30.0}, {"step": 3, "psnr": float("nan")}]
    (folder / "02" / runs.METRICS).write_text("".join(json.dumps(line) + "\n" for line in lines))
    comparison.main([str(folder), str(folder / "page.html"), "--views", "2"])
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', (folder / "page.html").read_text())
    (scene,) = json.loads(data[1])
    ours = ["a, loss.exposure_level 1.0", "a, loss.exposure_level 2.0", "b", "c (diverged at step 7)"]
    assert list(scene["pictures"]) == ["input", *ours, "truth"]
    assert len({tuple(pictures) for pictures in scene["pictures"].values()}) == len(scene["pictures"])
    assert (scene["times"], scene["size"]) == ([0.0, 1.0], [8, 6])
    assert list(scene["depths"]) == ours
    assert len({tuple(pictures) for pictures in scene["depths"].values()}) == 1
    assert scene["curves"]["b"] == [[1.0, 20.0], [2.0, 30.0]]
    assert scene["curves"][ours[0]] == []
    names[2] = "abd"
    with pytest.raises(UserError, match="02: has other held-out views"):
        comparison.main([str(folder), str(folder / "page.html")])


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
    with pytest.raises(UserError, match="expected a file in a writable folder"):
        comparison.main([str(folder), str(folder / output)])


@pytest.mark.slow
@pytest.mark.usefixtures("chromium")
def test_time_curtain_and_enlargement_follow_the_controls(tmp_path):
    flat = lambda grey: _url(np.full((30, 40, 3), grey, np.uint8))
    pictures = {name: [flat(20 * k), flat(20 * k + 9)] for k, name in enumerate(("input", "a", "b", "truth"))}
    depths = {name: [flat(100 + 20 * k), flat(109 + 20 * k)] for k, name in enumerate("ab")}
    curves = {"a": [[1.0, 20.0], [10.0, 30.0]], "b": []}
    shown = {"size": (40, 30), "times": [0.0, 0.5], "pictures": pictures, "depths": depths, "curves": curves}
    scenes = [shown | {"name": name} for name in ("x", "</script>")]
    write_page(tmp_path / "page.html", TEMPLATE, scenes)
    script = """
    const section = document.querySelectorAll("section")[1];
    const look = () => ({
      clock: section.querySelector("output").textContent,
      whole: [...section.querySelectorAll(".whole img")].map(image => image.src),
      depths: [...section.querySelectorAll(".depths img")].map(image => image.src),
      lines: [...section.querySelectorAll(".plot path")].map(line => line.getAttribute("d")),
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
    assert before["depths"] == [urls[0] for urls in depths.values()]
    assert after["depths"] == [urls[1] for urls in depths.values()]
    assert before["lines"] == ["M10 39L100 1", ""]
    assert (before["edge"], after["edge"]) == ("50%", "20%")
    assert before["crop"] == "50% 50%"
    crop = [float(part.strip("%")) for part in after["crop"].split()]
    assert crop == pytest.approx(
        [100 * (found["part"] - 0.1) / 0.8, 100], abs=0.01
    )  # a fifth is shown, a tenth to the left
