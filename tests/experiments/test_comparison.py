"""The page of methods side by side, in a browser."""

import shutil
from pathlib import Path

import browser
import numpy as np
import pytest

from experiments import comparison
from experiments.comparison import _url
from experiments.web_page import write_page

TEMPLATE = Path(comparison.__file__).with_suffix(".html")


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
    )  # a fifth is shown, and a tenth left
