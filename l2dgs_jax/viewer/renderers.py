"""The renderers of a run, one for every size, compiled before they are needed."""

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
from l2dgs_jax.viewer.ladder import STILL, Size

TRIED = 4  # trained views whose pairs tell how much room others need
MARGIN = 1.3  # of that room: whoever comes closer to the scene should not have to wait for a compiler


class Renderers:
    """Renders a run in those sizes whose programs are compiled, and compiles others in the background.

    Attributes:
        run: what is rendered.
        seconds: what a picture of a size takes, for those that are compiled.
    """

    def __init__(self, run: Run, told: Callable[[], None] = lambda: None, growing: bool = True):
        """Without any size yet.

        Args:
            run: what is rendered.
            told: called, from another thread, whenever a size has been compiled in the background.
            growing: whether anything is compiled in the background.
        """
        self.run, self.seconds = run, dict[Size, float]()
        self._told, self._growing = told, growing
        self._pairs: dict[Size, float] = {}
        self._ordered: set[Size] = set()
        self._background = ThreadPoolExecutor(1, "compile")

    def compile(self, size: Size) -> None:
        """Compile a size now, unless that was done, or its pictures are expected to take longer than `STILL`."""
        if size in self.seconds:
            return
        nearest = min(self.seconds, key=lambda other: abs(math.log(math.prod(other) / math.prod(size))), default=None)
        renderer = self.run.renderer(*size)
        if nearest:
            larger = math.prod(size) / math.prod(nearest)
            if larger * self.seconds[nearest] > STILL:
                return
            renderer.pair_capacity = next_capacity(MARGIN * larger * self._pairs[nearest])
        trained, frame = self.run.dataset.train.cameras, (self.run.dataset.width, self.run.dataset.height)
        taken = []
        for index in np.linspace(0, len(trained.time) - 1, TRIED).astype(int):
            camera = reframe(select_camera(trained, int(index)), frame, size)
            begun = time.perf_counter()
            output = jax.device_get(renderer(camera))
            taken.append(time.perf_counter() - begun)
            self._pairs[size] = max(float(output.pairs), self._pairs.get(size, 0.0))
        self.seconds[size] = min(taken)  # some of them compiled

    def order(self, sizes: Sequence[Size]) -> None:
        """Compile sizes in the background, in their order; those that were too slow are tried again."""
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
        """Those of the sizes that can be rendered at once; if there are none, whichever can."""
        return [size for size in sizes if size in self.seconds] or list(self.seconds)

    def render(self, camera: Camera, size: Size) -> RenderOutput:
        """Render a camera as NumPy arrays."""
        begun = time.perf_counter()
        output = jax.device_get(self.run.renderer(*size)(camera))
        taken, usual = time.perf_counter() - begun, self.seconds[size]
        self.seconds[size] = 0.8 * usual + 0.2 * min(taken, 2 * usual)  # a new compilation is not the pace
        return output

    def close(self) -> None:
        """Compile no more."""
        self._background.shutdown(wait=False, cancel_futures=True)
