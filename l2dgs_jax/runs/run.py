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
        config: its settings, what they left to the data filled in.
        dataset: the scene's footage.
        state: where its training stands.
        folder: where it lies on disk, if it does.
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
        """Whether the state is past the coarse stage, in which nothing moves."""
        return int(self.state.step) > self.config.coarse_steps

    def later(self, state: TrainState) -> "Run":
        """The run at another state; if that has the same shapes, known sizes are not compiled again."""
        run = dataclasses.replace(self, state=state)
        for size, renderer in list(self._renderers.items()):  # another thread may be adding to them
            run.renderer(*size).pair_capacity = renderer.pair_capacity
        return run

    def render(self, camera: Camera, width: int | None = None, height: int | None = None) -> RenderOutput:
        """Render one camera at its instant: well-lit and low-light image, L, R, B1, B2, alpha and depth.

        Views of a new size are compiled for it once. No gradients: `model.rendering.render` has them.

        Args:
            camera: one camera, `K` in pixels of the image wanted; `cameras.resize` makes other sizes of a given one.
            width: of the image, pixels; the data set's if neither is given.
            height: likewise.

        Raises:
            ValueError: only one of the two is given.
        """
        return self.renderer(width, height)(camera)

    def renderer(self, width: int | None = None, height: int | None = None) -> Renderer:
        """What `render` draws images of a size with."""
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
