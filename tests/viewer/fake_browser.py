"""A stand-in for a browser as viser presents it."""

import contextlib
from types import SimpleNamespace

import numpy as np


class Control:
    """A slider, a switch or a button."""

    def __init__(self, value):
        self._value, self._callbacks, self.disabled = value, [], False

    @property
    def value(self):
        return self._value

    @value.setter
    def value(self, value):
        self._set(value, None)

    def move(self, value):
        """Set the value as a person does in the browser."""
        self._set(value, "a browser")

    def on_update(self, callback):
        self._callbacks.append(callback)

    on_click = on_update

    def _set(self, value, client):
        if value != self._value:
            self._value = value
            for callback in self._callbacks:
                callback(SimpleNamespace(client=client, target=self))


class Gui:
    """Controls by name."""

    def __init__(self):
        self.controls = {}

    def __getitem__(self, name):
        return self.controls[name]

    def add_slider(self, name, low, high, step, value, hint=""):
        return self._add(name, value)

    def add_dropdown(self, name, options):
        return self._add(name, options[0])

    def add_checkbox(self, name, value, hint=""):
        return self._add(name, value)

    def add_button(self, name):
        return self._add(name, 0)

    def add_folder(self, name):
        return contextlib.nullcontext()

    def add_markdown(self, text):
        return SimpleNamespace(content=text)

    def _add(self, name, value):
        return self.controls.setdefault(name, Control(value))


class Client:
    """A browser with a window, a camera and the pictures that it was sent."""

    def __init__(self, window):
        self.gui, self.pictures, self.frusta, self.depth = Gui(), [], [], None
        self.camera = SimpleNamespace(
            image_width=window[0],
            image_height=window[1],
            wxyz=np.array([1.0, 0, 0, 0]),
            position=np.zeros(3),
            fov=1.0,
            on_update=lambda callback: setattr(self, "moved", callback),
        )
        self.scene = SimpleNamespace(set_background_image=self._show, add_camera_frustum=self._add_frustum)

    def fly(self, position):
        self.camera.position = np.array(position)
        self.moved(None)

    def atomic(self):
        return contextlib.nullcontext()

    def flush(self):
        pass

    def _show(self, image, depth, **_):
        self.pictures.append(image)
        self.depth = depth

    def _add_frustum(self, name, **facts):
        frustum = Control(0)
        frustum.facts, frustum.remove = facts, lambda: self.frusta.remove(frustum)
        self.frusta.append(frustum)
        return frustum
