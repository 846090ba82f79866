"""One browser: when it asks for a picture, and which picture it gets."""

from threading import Event, Thread
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
from fake_browser import Client
from scenes import write_nerfies

from l2dgs_jax.config import PRESETS, Config
from l2dgs_jax.data import load_dataset
from l2dgs_jax.runs.pictures import Output
from l2dgs_jax.types import Decomposition, RenderOutput
from l2dgs_jax.viewer import panel
from l2dgs_jax.viewer.guest import MAX_FRUSTA, Guest
from l2dgs_jax.viewer.ladder import SECONDS_MOVING, ladder
from l2dgs_jax.viewer.renderers import Renderers
from l2dgs_jax.viewer.stage import Stage

WINDOW = 640, 360
RANGES = {"b1": (1.0, 2.0), "b2": (5.0, 10.0), "depth": (0.0, 4.0)}


class FakeRenderers(Renderers):
    """Renders a grey ramp, and remembers what it was asked for."""

    def __init__(self, sizes):
        self.seconds, self.asked, self.ordered = dict.fromkeys(sizes, 0.02), [], []
        self.run = SimpleNamespace(state=SimpleNamespace(step=7), config=Config())

    def order(self, sizes):
        self.ordered = list(sizes)

    def render(self, camera, size):
        self.asked.append((camera, size))
        width, height = size
        grey = np.tile(np.linspace(0.1, 0.9, width), (height, 1))
        colour = np.repeat(grey[..., None], 3, axis=-1)
        dark, exponents = colour**4, np.stack([1.2 + 0 * grey, 8 + grey], axis=-1)
        images = Decomposition(grey[..., None] * colour, dark, grey, colour, exponents)
        return RenderOutput(images, 0 * grey + 1, 1 + grey, np.zeros(3), np.int32(1), np.bool_(False))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return load_dataset(write_nerfies(tmp_path_factory.mktemp("scene"), truth=True))


@pytest.fixture
def renderers():
    return FakeRenderers(ladder(WINDOW))


class Visit:
    def __init__(self, dataset, renderers):
        stage = Stage.of(dataset.train.cameras, dataset.points, (dataset.width, dataset.height))
        self.client, self.asked = Client(WINDOW), 0
        self.guest = Guest(self.client, dataset, stage, renderers, RANGES, self._ask)
        self.gui = self.client.gui

    def _ask(self):
        self.asked += 1

    def next_picture(self, sharpen=False):
        self.more = self.guest.draw(sharpen)
        return self.client.pictures[-1]


@pytest.fixture
def visit(dataset, renderers):
    return Visit(dataset, renderers)


def test_the_first_picture_is_the_first_trained_view(dataset, visit, renderers):
    picture = visit.next_picture()
    camera, size = renderers.asked[-1]
    assert picture.shape == (size[1], size[0], 3)
    np.testing.assert_allclose(camera.time, dataset.train.cameras.time.min())
    assert renderers.ordered == list(ladder(WINDOW))


def test_only_a_new_camera_window_or_instant_needs_a_rendering(visit, renderers):
    visit.next_picture()
    for name, value in (("Brightness", 1.5), ("Curtain", 0.5), ("Show", "depth"), ("Gain", -1.0)):
        asked = visit.asked
        visit.gui[name].move(value)
        assert visit.asked == asked + 1
        visit.next_picture()
    assert len(renderers.asked) == 1
    visit.gui["Instant"].move(0.5)
    visit.next_picture()
    visit.client.fly([0.1, 0, 0])
    visit.next_picture()
    assert len(renderers.asked) == 3
    assert [float(camera.time) for camera, _ in renderers.asked[1:]] == [0.5, 0.5]


def test_a_later_state_needs_a_rendering(visit, renderers):
    visit.next_picture()
    visit.next_picture()
    renderers.run.state.step = 8
    visit.next_picture()
    assert len(renderers.asked) == 2


def test_each_output_is_a_different_picture(visit):
    shown = []
    for name in panel.OUTPUT_NAMES:
        visit.gui["Show"].move(name)
        shown.append(visit.next_picture())
    assert set(panel.OUTPUT_NAMES.values()) == set(get_args(Output))
    # The fake renderers draw illumination and reflectance alike.
    different = {picture.tobytes() for picture in shown}
    assert len(different) == len(panel.OUTPUT_NAMES) - 1


def test_the_curtain_is_dark_on_its_left_only(visit):
    lit = visit.next_picture()
    visit.gui["Show"].move("low-light")
    dark = visit.next_picture()
    visit.gui["Show"].move("well-lit")
    visit.gui["Curtain"].move(0.5)
    both = visit.next_picture()
    middle = lit.shape[1] // 2
    np.testing.assert_array_equal(both[:, : middle - 1], dark[:, : middle - 1])
    np.testing.assert_array_equal(both[:, middle:], lit[:, middle:])


def test_brightness_brightens_and_can_be_reset(visit):
    before = visit.next_picture()
    visit.gui["Brightness"].move(1.6)
    assert visit.next_picture().mean() > before.mean() + 5
    visit.gui["Well-lit again"].move(1)
    np.testing.assert_array_equal(visit.next_picture(), before)


def test_small_pictures_while_moving_and_large_ones_when_still(visit, renderers):
    smallest, largest = ladder(WINDOW)
    renderers.seconds[largest] = 2 * SECONDS_MOVING
    visit.next_picture()
    assert renderers.asked[-1][1] == smallest
    assert visit.more
    assert visit.next_picture(sharpen=True).shape[1] == largest[0]
    assert not visit.more
    visit.gui["Warmth"].move(0.5)  # keeps the large one
    assert visit.next_picture().shape[1] == largest[0]
    visit.client.fly([0.2, 0, 0])
    assert visit.next_picture().shape[1] == smallest[0]


def test_nothing_waits_for_a_size_that_is_not_compiled(dataset, visit, renderers):
    smallest, largest = ladder(WINDOW)
    del renderers.seconds[largest]
    visit.next_picture()
    assert not visit.more
    visit.client.camera.image_width, visit.client.camera.image_height = 300, 600  # turned upright
    visit.client.moved(None)
    assert visit.next_picture().shape[1::-1] == smallest
    assert smallest not in renderers.ordered


def test_every_browser_has_its_own_state(dataset, renderers):
    one, other = Visit(dataset, renderers), Visit(dataset, renderers)
    before = other.next_picture()
    one.gui["Instant"].move(0.8)
    one.gui["Brightness"].move(0.0)
    one.client.fly([0.3, 0, 0])
    one.next_picture()
    np.testing.assert_array_equal(other.next_picture(), before)
    assert other.gui["Instant"].value < 0.5
    assert len(renderers.asked) == 2


def test_playing_asks_for_the_next_picture_and_moves_the_slider(visit, monkeypatch):
    clock = [50.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    visit.next_picture()
    visit.gui["Loop"].move(False)
    visit.gui["Play"].move(True)
    seen, start = [], visit.gui["Instant"].value
    for _ in range(8):
        clock[0] += 1.0
        asked = visit.asked
        visit.next_picture()
        seen.append(visit.gui["Instant"].value)
        assert visit.asked == asked + visit.gui["Play"].value
    assert seen[:2] == pytest.approx([start + 0.25, start + 0.5], abs=1e-3)
    assert seen[-1] == 1
    assert not visit.gui["Play"].value
    visit.gui["Play"].move(True)  # from the beginning
    clock[0] += 1.0
    visit.next_picture()
    assert visit.gui["Instant"].value == 0.25


def test_filmed_frames_can_be_shown_hidden_and_flown_to(dataset, visit, renderers):
    visit.next_picture()
    assert visit.client.depth is None
    visit.gui["Filmed frames"].move(True)
    names = dataset.train.names
    assert len(visit.client.frusta) == min(MAX_FRUSTA, len(names))
    visit.next_picture()
    assert visit.client.depth.shape == visit.client.pictures[-1].shape[:2]
    visit.client.frusta[3].move(1)
    visit.next_picture()
    camera = renderers.asked[-1][0]
    np.testing.assert_allclose(camera.time, dataset.train.cameras.time[3], atol=1e-6)
    visit.gui["Filmed frames"].move(False)
    assert not visit.client.frusta
    visit.next_picture()
    assert visit.client.depth is None


def test_filmed_frames_that_are_hidden_while_they_are_being_shown_do_not_stay(visit, monkeypatch):
    box, add, begun, go_on = visit.gui["Filmed frames"], visit.client.scene.add_camera_frustum, Event(), Event()

    def slow(*arguments, **facts):
        begun.set()
        go_on.wait(10)
        return add(*arguments, **facts)

    monkeypatch.setattr(visit.client.scene, "add_camera_frustum", slow)
    clicks = [Thread(target=box.move, args=(shown,)) for shown in (True, False)]
    clicks[0].start()
    begun.wait(10)
    clicks[1].start()
    clicks[1].join(0.1)  # it may have to wait for the first one
    go_on.set()
    for click in clicks:
        click.join()
    assert not visit.client.frusta


def test_what_acts_on_the_decomposition_is_disabled_without_one(dataset, renderers):
    assert not any(control.disabled for control in Visit(dataset, renderers).gui.controls.values())
    renderers.run.config = PRESETS["curve-4dgs"]
    controls = Visit(dataset, renderers).gui.controls
    assert {name for name, control in controls.items() if control.disabled} == {"Brightness", "Shading"}
