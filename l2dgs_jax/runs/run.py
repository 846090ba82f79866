"""A trained scene together with what it was trained on."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

from l2dgs_jax.config import Config
from l2dgs_jax.data import Dataset
from l2dgs_jax.model.rendering import Renderer
from l2dgs_jax.training.objective import sh_degree
from l2dgs_jax.training.state import TrainState
from l2dgs_jax.types import Camera, RenderOutput


@dataclass(frozen=True)
class Run:
    """A trained scene.

    Attributes:
        config: its settings, resolved by `training.resolve`.
        dataset: the frames that it was trained on, and those held out.
        state: its training state.
        folder: its folder on disk, if it has one.
    """

    config: Config
    dataset: Dataset
    state: TrainState
    folder: Path | None = None
    _renderers: dict[tuple[int, int], Renderer] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def name(self) -> str:
        """For messages: the folder, or the name of the data set."""
        return str(self.folder or self.dataset.name)

    @property
    def moving(self) -> bool:
        """Whether the state is past the coarse stage, in which the motion field does not act."""
        return int(self.state.step) > self.config.coarse_steps

    def later(self, state: TrainState) -> "Run":
        """The run with another state; if that has the same shapes, renderers are not compiled again."""
        run = dataclasses.replace(self, state=state)
        for size, renderer in list(self._renderers.items()):  # another thread may be adding to them
            run.renderer(*size).pair_capacity = renderer.pair_capacity
        return run

    def render(self, camera: Camera, width: int | None = None, height: int | None = None) -> RenderOutput:
        """Render one camera at its instant: well-lit and low-light image, L, R, B1, B2, alpha and depth.

        The first image of each size compiles a renderer. There are no gradients: `model.rendering.render` has them.

        Args:
            camera: one camera, with `K` in pixels of the image; `cameras.resize` adapts a camera to other sizes.
            width: of the image, pixels; that of the data set if neither is given.
            height: of the image, pixels; that of the data set if neither is given.

        Raises:
            ValueError: only one of the two is given.
        """
        return self.renderer(width, height)(camera)

    def renderer(self, width: int | None = None, height: int | None = None) -> Renderer:
        """The renderer that `render` uses for images of a size."""
        if (width is None) != (height is None):
            raise ValueError(f"an image {width} wide and {height} high; expected both numbers, or neither")
        size = width or self.dataset.width, height or self.dataset.height
        if size not in self._renderers:
            self._renderers[size] = Renderer(
                self.state.scene,
                self.config.model,
                *size,
                moving=self.moving,
                sh_degree=int(sh_degree(int(self.state.step), self.config)),
            )
        return self._renderers[size]
