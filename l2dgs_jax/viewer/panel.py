"""The controls of one browser."""

import time
from collections.abc import Callable
from typing import Any

from l2dgs_jax.runs.pictures import Output
from l2dgs_jax.viewer.playhead import Playhead
from l2dgs_jax.viewer.relighting import Light

OUTPUT_NAMES: dict[str, Output] = {
    "well-lit": "welllit",
    "low-light": "lowlight",
    "L, illumination": "illumination",
    "R, reflectance": "reflectance",
    "B1, exponent of R": "b1",
    "B2, exponent of L": "b2",
    "depth": "depth",
    "alpha": "alpha",
}


class Panel:
    """The controls and their values.

    Attributes:
        frusta: the checkbox that shows the training cameras.
        home: the button that returns to the first of them.
        status: a line of text.
    """

    def __init__(self, gui: Any, changed: Callable[[], None], decomposed: bool):
        """Create the controls.

        Args:
            gui: that of a viser client.
            changed: called when the user has changed a control.
            decomposed: whether views have L, B1 and B2, which some controls act on.
        """
        self._changed, self._playhead = changed, Playhead.now(0.0)
        self._kind = gui.add_dropdown("Show", tuple(OUTPUT_NAMES))
        self._curtain = gui.add_slider("Curtain", 0.0, 1.0, 0.005, 0.0, hint="Left of it: as dark as it was filmed")
        with gui.add_folder("Time"):
            self._instant = gui.add_slider("Instant", 0.0, 1.0, 0.001, 0.0, hint="0 is the first frame, 1 the last")
            self._playing = gui.add_checkbox("Play", False)
            self._loop = gui.add_checkbox("Loop", True)
            self._duration = gui.add_slider("Seconds", 1.0, 30.0, 0.5, 4.0, hint="From the first frame to the last")
        with gui.add_folder("Light"):
            slider = lambda name, low, high, value, hint: gui.add_slider(name, low, high, 0.01, value, hint=hint)
            self._light = Light(
                brightness=slider("Brightness", 0.0, 2.0, 1.0, "0 as filmed, 1 well-lit: powers of B1 and B2"),
                shading=slider("Shading", 0.0, 2.0, 1.0, "Exponent of L: 0 is light that is the same everywhere"),
                gain=slider("Gain", -3.0, 3.0, 0.0, "On linear light, stops"),
                warmth=slider("Warmth", -1.0, 1.0, 0.0, "White balance from blue to orange"),
                tint=slider("Tint", -1.0, 1.0, 0.0, "White balance from green to magenta"),
            )
            self._light.brightness.disabled = self._light.shading.disabled = not decomposed
            well_lit = gui.add_button("Well-lit again")
        with gui.add_folder("Camera"):
            self.home = gui.add_button("To the first frame")
            self.frusta = gui.add_checkbox("Filmed frames", False, hint="Click one to stand where it was filmed")
        self.status = gui.add_markdown("")

        for control in (self._kind, self._curtain, *self._light):
            control.on_update(lambda _: changed())
        for control in (self._instant, self._playing, self._loop, self._duration):
            control.on_update(self._play_from_here)
        well_lit.on_click(self._reset_light)

    @property
    def kind(self) -> Output:
        """The kind of output to show."""
        return OUTPUT_NAMES[self._kind.value]

    @property
    def curtain(self) -> float:
        """The share of the width that the curtain covers."""
        return self._curtain.value

    @property
    def light(self) -> Light:
        """How the well-lit image is lit."""
        return Light(*(slider.value for slider in self._light))

    @property
    def playing(self) -> bool:
        """Whether time runs."""
        return self._playing.value

    def instant(self) -> float:
        """The instant to show now; moves the slider to it."""
        if self.playing:
            instant, goes_on = self._playhead.at(time.monotonic(), self._duration.value, self._loop.value)
            self._instant.value = round(instant, 3)
            self._playing.value = goes_on
        return self._instant.value

    def jump(self, instant: float) -> None:
        """Go to another instant."""
        self._playhead = Playhead.now(instant)
        self._instant.value = instant

    def _play_from_here(self, event: Any) -> None:
        if event.client is not None:  # changed by the user, not by this class
            at_end = event.target is self._playing and self._instant.value == 1.0
            self._playhead = Playhead.now(0.0 if at_end else self._instant.value)
            self._changed()

    def _reset_light(self, _: Any) -> None:
        for slider, value in zip(self._light, Light(), strict=True):
            slider.value = value
