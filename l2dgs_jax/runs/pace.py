"""How long the steps of a training that lie ahead will take."""

import collections
import statistics
import time

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from l2dgs_jax.config import Config
from l2dgs_jax.training import engine, relocation

FINE = 1.6  # steps of the coarse stage that one of the fine stage takes as long as
STANDING = 20_000  # Gaussians that take as long as all of a step that does not depend on their number (docs/speed.md)
RECENT = 32  # steps that are timed; their median does not mind a compilation or a checkpoint among them


class Pace:
    """Tells the seconds left, at the speed of the last steps, from what they did and what those ahead have to do.

    Births are known beforehand; growth that follows the image (`density.method` "adaptive") is not, and the time left
    then grows with the Gaussians.
    """

    def __init__(self, config: Config, done: int, gaussians: int):
        """Begin to time.

        Args:
            config: settings, what they left to the data filled in.
            done: number of steps already taken.
            gaussians: how many there are then.
        """
        self.done, self.compiled = done, (done + 1, config.coarse_steps + 1)  # with the first step of a stage
        self.work = _work(config, done, gaussians)
        self.ahead = self.work[::-1].cumsum()[::-1] - self.work
        self.recent: collections.deque[float] = collections.deque(maxlen=RECENT)
        self.last = time.monotonic()

    def __call__(self, step: int) -> float | None:
        """Seconds left after a step, which every step is told of; None before there is something to tell them from."""
        now, index = time.monotonic(), step - self.done - 1
        if step not in self.compiled:
            self.recent.append((now - self.last) / self.work[index])
        self.last = now
        return float(statistics.median(self.recent) * self.ahead[index]) if self.recent else None


def _work(config: Config, done: int, gaussians: int) -> Float[np.ndarray, " S"]:
    """What each step after the first `done` has to do, in no unit."""
    work, stages = np.empty(config.steps - done), ((0, config.coarse_steps), (config.coarse_steps, config.fine_steps))
    for step in range(done + 1, config.steps + 1):
        fine = step > config.coarse_steps
        start, steps = stages[fine]
        work[step - done - 1] = (FINE if fine else 1) * (STANDING + gaussians)
        if config.density.method == "mcmc" and engine.density_due(step - start, config):
            most, left = int(config.density.max_gaussians), engine.growths_left(step - start, steps, config)
            gaussians = int(relocation.population(jnp.asarray(gaussians), most, left))
    return work
