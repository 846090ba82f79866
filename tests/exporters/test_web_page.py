"""The web page of a scene: its contents, and what it shows in a browser."""

import base64
import dataclasses
import json
import re
import time
import zlib
from html.parser import HTMLParser

import browser
import finished_run
import jax.numpy as jnp
import numpy as np
import pytest

from l2dgs_jax import rasterize
from l2dgs_jax.cameras import resize
from l2dgs_jax.exporters import tracks, web_page
from l2dgs_jax.exporters.baking import OVERBRIGHT, bake, near_plane
from l2dgs_jax.exporters.splats import Splats
from l2dgs_jax.rasterizer.projection import EPS_2D

SECONDS = 2.5


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return finished_run.opened(tmp_path_factory.getbasetemp())


class Elements(HTMLParser):
    """The elements of a page, with their attributes and text."""

    def __init__(self, page):
        super().__init__()
        self.found, self.inside = [], []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.found.append([tag, dict(attributes), ""])

    def handle_data(self, data):
        if self.found:
            self.found[-1][2] += data

    def text(self, tag, **attributes):
        return next(text.strip() for t, a, text in self.found if t == tag and attributes.items() <= a.items())


def random_tracks(run):
    rng = np.random.default_rng(0)
    points = np.asarray(run.dataset.points, np.float32)
    quats = np.tile(np.array([[1, 0, 0, 0]], np.float32), (len(points), 1))
    rows = lambda *shape: rng.uniform(0.1, 1, (len(points), *shape)).astype(np.float32)
    instants = [(Splats(points + rows(3), quats, rows(3), rows(), rows(3)),) * 2 for _ in range(3)]
    return tracks.quantise(instants, rows(), OVERBRIGHT)


def test_a_page_contains_everything_and_loads_nothing(run):
    named = dataclasses.replace(run, dataset=dataclasses.replace(run.dataset, name="</script><b>A & B"))
    quantised = random_tracks(run)
    page = web_page.page(named, quantised, np.array([[30.0, 40], [32, 42]]), SECONDS)
    elements = Elements(page)
    assert elements.text("title") == elements.text("h1") == "</script><b>A & B"
    assert "b" not in {tag for tag, _, _ in elements.found}
    assert "31.0 dB well lit (at worst 30.0), and 41.0 dB as filmed (at worst 40.0)" in page
    description = json.loads(elements.text("script", id="description"))
    assert description["seconds"] == SECONDS
    assert [camera["time"] for camera in description["cameras"]] == sorted(
        camera["time"] for camera in description["cameras"]
    )
    assert zlib.decompress(base64.b64decode(elements.text("script", id="data"))) == tracks.pack(quantised)
    assert not {"src", "srcset", "action"} & {name for _, attributes, _ in elements.found for name in attributes}
    assert {a["href"] for _, a, _ in elements.found if "href" in a} == {"data:,"}
    assert not re.search(r"https?:|//cdn|@import|url\(", page)


def test_controls_have_accessible_names(run):
    elements = Elements(web_page.page(run, random_tracks(run), np.full((2, 2), 30.0), SECONDS))
    for tag, attributes, text in elements.found:
        if tag in ("button", "input", "canvas"):
            assert text.strip() or attributes.get("aria-label"), attributes


@pytest.fixture(scope="module")
def baked_page(run, tmp_path_factory):
    """Tracks of a baked scene that moves, and the page that plays them."""
    instants = list(bake(run, np.linspace(0, 1, 5).tolist(), OVERBRIGHT, web_page.IMAGES))
    sizes = web_page.pixel_sizes(run.dataset.train.cameras, instants, near_plane(run))
    quantised = tracks.quantise(instants, sizes, OVERBRIGHT)
    path = tmp_path_factory.mktemp("page") / "scene.html"
    path.write_text(web_page.page(run, quantised, np.full((1, 2), 30.0), SECONDS), "utf-8")
    return quantised, path


WIDTH, HEIGHT = 240, 180  # ten times what the scene was trained at


@pytest.fixture(scope="module")
def visit(baked_page, tmp_path_factory, chromium):
    """A function that opens the page, paused and with nothing over the picture."""
    with browser.opened(baked_page[1].as_uri(), tmp_path_factory.mktemp("browser"), (WIDTH, HEIGHT)) as tab:
        yield lambda: paused(tab())


def paused(page):
    browser.awaited(lambda: page.says("document.getElementById('controls')?.hidden === false"))
    if page.says("document.getElementById('play').textContent") == "Pause":
        page.says("document.getElementById('play').click()")
    page.says("for (const e of document.querySelectorAll('header, #controls')) e.style.visibility = 'hidden'")
    return page


def picture(page):
    """What the page shows once it no longer changes."""
    browser.awaited(lambda: page.says("document.getElementById('view').ariaBusy") == "false")
    return page.picture() / 255


def seek(page, time):
    page.says(f"(s => {{ s.value = {time}; s.dispatchEvent(new Event('input')) }})(document.getElementById('time'))")


def stand_at(page, run, index):
    """Go to a training camera at its instant."""
    camera = run.dataset.train.camera(index)
    seek(page, float(camera.time))
    page.says("document.getElementById('reset').click()")
    return camera


@pytest.mark.slow
def test_the_player_draws_as_the_rasterizer_does(run, baked_page, visit):
    page = visit()
    for index in (0, 3, 6):
        camera = stand_at(page, run, index)
        for image in range(2):
            splats = tracks.at(baked_page[0], float(camera.time))[image]
            arrays = [
                jnp.asarray(x, float) for x in (*splats, camera.viewmat, resize(camera, WIDTH // run.dataset.width).K)
            ]
            blur = EPS_2D * (WIDTH / run.dataset.width) ** 2
            drawn = rasterize(*arrays, WIDTH, HEIGHT, near_plane=near_plane(run), eps2d=blur)
            difference = np.abs(picture(page) - np.clip(drawn.features, 0, 1))
            assert difference.mean() < 0.004
            assert np.quantile(difference, 0.99) < 0.02
            page.says("document.getElementById('dark').click()")


@pytest.mark.slow
def test_the_page_shows_what_the_model_renders(run, visit):
    page = visit()
    camera = stand_at(page, run, 2)
    images = run.render(camera).images
    coarse = picture(page).reshape(run.dataset.height, 10, run.dataset.width, 10, 3).mean((1, 3))
    assert np.abs(coarse - images.welllit).mean() < 0.04
    assert coarse.std() > 0.05  # there is something to see
    page.press("l")
    dark = picture(page).reshape(run.dataset.height, 10, run.dataset.width, 10, 3).mean((1, 3))
    assert np.abs(dark - images.lowlight).mean() < 0.04
    assert dark.mean() < 0.6 * coarse.mean()


@pytest.mark.slow
def test_controls_change_the_picture_and_reset_brings_it_back(visit):
    page = visit()
    page.says("document.getElementById('reset').click()")
    inside = np.s_[5:-5, 5:-5]  # within the ring that shows the focus
    first = picture(page)[inside]
    differs = lambda: np.abs(picture(page)[inside] - first).mean() > 0.003

    middle = (WIDTH // 2, HEIGHT // 2)
    gestures = {
        "turn": lambda: page.drag(middle, (WIDTH // 2 + 40, HEIGHT // 2 + 10)),
        "move": lambda: page.drag(middle, (WIDTH // 2 + 40, HEIGHT // 2), modifiers=8),
        "zoom": lambda: page.wheel(middle, -300),
        "finger": lambda: page.touch([middle, (WIDTH // 2 - 40, HEIGHT // 2)]),
        "pinch": lambda: page.touch([(100, 90), (60, 90)], [(140, 90), (180, 90)]),
        "keys": lambda: page.press("ArrowRight"),
    }
    page.says("document.getElementById('view').focus()")
    for name, gesture in gestures.items():
        gesture()
        assert differs(), name
        page.press("r")
        np.testing.assert_allclose(picture(page)[inside], first, atol=0.02)
    seek(page, 0.6)
    assert differs()
    page.press(" ")
    seen = [page.says("document.getElementById('time').valueAsNumber") for _ in range(2) if not time.sleep(0.5)]
    assert len({0.6, *seen}) == 3  # time runs
    assert not page.complaints()
    assert {address.partition(":")[0] for address in page.addresses()} <= {"file", "blob", "data"}
