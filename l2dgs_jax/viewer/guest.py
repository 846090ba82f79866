"""One browser, called a guest: its window, its controls, and the picture that it shows."""

import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from l2dgs_jax.cameras import select_camera
from l2dgs_jax.data import Dataset
from l2dgs_jax.data.images import to_bytes
from l2dgs_jax.data.stacks import evenly_spread
from l2dgs_jax.types import RenderOutput
from l2dgs_jax.viewer import ladder
from l2dgs_jax.viewer.ladder import Size
from l2dgs_jax.viewer.panel import Panel
from l2dgs_jax.viewer.picture import hiding_depth, picture
from l2dgs_jax.viewer.renderers import Renderers
from l2dgs_jax.viewer.stage import Stage
from l2dgs_jax.visualize import display

JPEG_QUALITY = 90
MAX_FRUSTA = 40  # training cameras that are shown
THUMBNAIL_WIDTH = 96  # of their frames, pixels
FRUSTUM_SIZE = 0.08  # units of the stage


class View(NamedTuple):
    """What a picture depends on, except its size and the light."""

    step: int
    wxyz: tuple[float, ...]
    position: tuple[float, ...]
    field: float
    window: Size
    instant: float


class Shown(NamedTuple):
    """The rendered view that a browser shows."""

    view: View
    size: Size
    output: RenderOutput


class Guest:
    """A browser and what it shows."""

    def __init__(
        self,
        client: Any,
        dataset: Dataset,
        stage: Stage,
        renderers: Renderers,
        ranges: display.Ranges,
        changed: Callable[[], None],
    ):
        """Create the controls and go to the first training view.

        Args:
            client: a viser client.
            dataset: the scene's frames and cameras.
            stage: conversion between the scene's and the browser's cameras.
            renderers: render the scene.
            ranges: of the colour-mapped kinds of output.
            changed: called when the picture is out of date.
        """
        self._client, self._dataset, self._stage = client, dataset, stage
        self._renderers, self._ranges, self._changed = renderers, ranges, changed
        self._shown: Shown | None = None
        self._frusta: list[Any] = []
        self._frusta_change = threading.Lock()
        first = int(np.argmin(dataset.train.cameras.time))
        self._panel = Panel(client.gui, changed, renderers.run.config.model.decomposition == "retinex")
        self._panel.home.on_click(lambda _: self._go(first))
        self._panel.frusta.on_update(lambda _: self._show_frusta())
        client.camera.on_update(lambda _: self._moved())
        self._go(first)

    def draw(self, sharpen: bool) -> bool:
        """Bring the picture up to date, or if `sharpen` and it is, render it at the next larger size.

        Returns:
            Whether there is a still larger size.
        """
        view = self._view()
        sizes = self._renderers.compiled(ladder.ladder(view.window))
        if self._shown is None or self._shown.view != view:
            self._shown = self._rendered(view, ladder.while_moving(sizes, self._renderers.seconds))
        elif sharpen and (size := ladder.sharper(sizes, self._shown.size)):
            self._shown = self._rendered(view, size)
        self._send(self._shown)
        if self._panel.playing:
            self._changed()
        return ladder.sharper(sizes, self._shown.size) is not None

    def _view(self) -> View:
        camera = self._client.camera
        step, instant = int(self._renderers.run.state.step), self._panel.instant()
        return View(step, tuple(camera.wxyz), tuple(camera.position), camera.fov, self._window(), instant)

    def _window(self) -> Size:
        camera = self._client.camera
        return max(camera.image_width, 1), max(camera.image_height, 1)

    def _rendered(self, view: View, size: Size) -> Shown:
        _, wxyz, position, field, window, instant = view
        camera = self._stage.camera(np.array(wxyz), np.array(position), field, window, size, instant)
        return Shown(view, size, self._renderers.render(camera, size))

    def _send(self, shown: Shown) -> None:
        panel = self._panel
        cfg = self._renderers.run.config.model
        image = picture(shown.output, cfg, panel.kind, panel.light, panel.curtain, self._ranges)
        depth = hiding_depth(shown.output, self._stage.unit) if self._frusta else None
        self._client.scene.set_background_image(image, format="jpeg", jpeg_quality=JPEG_QUALITY, depth=depth)
        self._client.flush()
        width, height = shown.size
        panel.status.content = f"{width} x {height}, {1000 * self._renderers.seconds[shown.size]:.0f} ms"

    def _moved(self) -> None:
        self._renderers.order(ladder.ladder(self._window()))
        self._changed()

    def _go(self, index: int) -> None:
        """Go to the camera and the instant of a training view."""
        camera = self._client.camera
        trained = select_camera(self._dataset.train.cameras, index)
        pose = self._stage.pose(trained, self._window())
        with self._client.atomic():
            camera.up_direction = pose.up
            camera.position = pose.position
            camera.look_at = pose.look_at
            camera.fov = pose.field
        self._panel.jump(float(trained.time))
        self._moved()

    def _show_frusta(self) -> None:
        with self._frusta_change:  # each click has its own thread, and frusta take a moment to make
            for frustum in self._frusta:
                frustum.remove()
            chosen = evenly_spread(len(self._dataset.train.names), MAX_FRUSTA) if self._panel.frusta.value else ()
            self._frusta = [self._frustum(int(index)) for index in chosen]
        self._changed()

    def _frustum(self, index: int) -> Any:
        split, (width, height) = self._dataset.train, self._stage.frame
        camera = select_camera(split.cameras, index)
        pose = self._stage.pose(camera, self._stage.frame)
        thumbnail = (THUMBNAIL_WIDTH, round(height * THUMBNAIL_WIDTH / width))
        frustum = self._client.scene.add_camera_frustum(
            f"/filmed/{index}",
            fov=pose.field,
            aspect=width / height,
            scale=FRUSTUM_SIZE,
            thickness=1.5,
            thickness_units="screen",
            color=(255, 200, 90),
            image=cv2.resize(to_bytes(split.images[index]), thumbnail, interpolation=cv2.INTER_AREA),
            wxyz=np.roll(Rotation.from_matrix(np.asarray(camera.viewmat)[:3, :3].T).as_quat(), 1),
            position=pose.position,
        )
        frustum.on_click(lambda _: self._go(index))
        return frustum
