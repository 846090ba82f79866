"""The renderers of a run, one for every picture size, compiled before they are needed."""

import math
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from l2dgs_jax.cameras import reframe, select_camera
from l2dgs_jax.runs.run import Run
from l2dgs_jax.runtime.capacity import next_capacity
from l2dgs_jax.types import Camera, RenderOutput
from l2dgs_jax.viewer.ladder import SECONDS_STILL, Size

MEASURED_VIEWS = 4  # training views from which time and number of pairs are measured
PAIR_MARGIN = 1.3  # on the size of the pair buffer, so that moving closer to the scene does not wait for a compilation


class Renderers:
    """Renders a run at the sizes whose programs are compiled, and compiles others in the background.

    Attributes:
        run: the run.
        seconds: time to render a picture, for every compiled size.
    """

    def __init__(self, run: Run, told: Callable[[], None] = lambda: None, growing: bool = True):
        """Start without any compiled size.

        Args:
            run: the run to render.
            told: called, from another thread, whenever a size has been compiled in the background.
            growing: whether sizes are compiled in the background.
        """
        self.run, self.seconds = run, dict[Size, float]()
        self._told, self._growing = told, growing
        self._pairs: dict[Size, float] = {}
        self._ordered: set[Size] = set()
        self._background = ThreadPoolExecutor(1, "compile")

    def compile(self, size: Size) -> None:
        """Compile a size now, unless it already is or its pictures are expected to take longer than `SECONDS_STILL`."""
        if size in self.seconds:
            return
        nearest = min(self.seconds, key=lambda other: abs(math.log(math.prod(other) / math.prod(size))), default=None)
        renderer = self.run.renderer(*size)
        if nearest:
            larger = math.prod(size) / math.prod(nearest)
            if larger * self.seconds[nearest] > SECONDS_STILL:
                return
            renderer.pair_capacity = next_capacity(PAIR_MARGIN * larger * self._pairs[nearest])
        trained, frame = self.run.dataset.train.cameras, (self.run.dataset.width, self.run.dataset.height)
        taken = []
        for index in np.linspace(0, len(trained.time) - 1, MEASURED_VIEWS).astype(int):
            camera = reframe(select_camera(trained, int(index)), frame, size)
            begun = time.perf_counter()
            output = jax.device_get(renderer(camera))
            taken.append(time.perf_counter() - begun)
            self._pairs[size] = max(float(output.pairs), self._pairs.get(size, 0.0))
        self.seconds[size] = min(taken)  # the others may include a compilation

    def order(self, sizes: Sequence[Size]) -> None:
        """Compile sizes in the background, in their order; sizes that were skipped as too slow are tried again."""
        for size in sizes if self._growing else ():
            if size not in self.seconds and size not in self._ordered:
                self._ordered.add(size)
                self._background.submit(self._compile_and_tell, size)

    def _compile_and_tell(self, size: Size) -> None:
        try:
            self.compile(size)
        except (MemoryError, jax.errors.JaxRuntimeError) as error:  # the smaller sizes remain
            print(f"warning: no pictures of {size[0]}x{size[1]} pixels: {error}", file=sys.stderr)
        self._ordered.discard(size)
        if size in self.seconds:
            self._told()

    def compiled(self, sizes: Sequence[Size]) -> list[Size]:
        """Those of the sizes that are compiled; if none is, all compiled sizes."""
        return [size for size in sizes if size in self.seconds] or list(self.seconds)

    def render(self, camera: Camera, size: Size) -> RenderOutput:
        """Render a camera as NumPy arrays."""
        begun = time.perf_counter()
        output = jax.device_get(self.run.renderer(*size)(camera))
        taken, usual = time.perf_counter() - begun, self.seconds[size]
        self.seconds[size] = 0.8 * usual + 0.2 * min(taken, 2 * usual)  # limits the effect of a compilation
        return output

    def close(self) -> None:
        """Stop compiling."""
        self._background.shutdown(wait=False, cancel_futures=True)
