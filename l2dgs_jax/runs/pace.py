"""Estimate of the time that the remaining steps of a training will take."""

import collections
import statistics
import time

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from l2dgs_jax.config import Config
from l2dgs_jax.training import engine, relocation

FINE_STEP = 1.6  # time of a step of the fine stage, over one of the coarse stage
FIXED_COST = 20_000  # time of a step that does not depend on the number of Gaussians, in Gaussians (docs/speed.md)
TIMED_STEPS = 32  # latest steps whose median time is used, which ignores a compilation or checkpoint among them


class Pace:
    """Estimates the seconds left from the speed of the latest steps and the work of the remaining ones.

    With `density.method` "mcmc" the number of Gaussians is known in advance. With "adaptive" it is not, and the
    estimate rises as Gaussians are added.
    """

    def __init__(self, config: Config, done: int, gaussians: int):
        """Start the clock.

        Args:
            config: settings, resolved by `training.resolve`.
            done: number of steps already taken.
            gaussians: number of Gaussians at this point.
        """
        self.done, self.compiled = done, (done + 1, config.coarse_steps + 1)  # steps that include a compilation
        self.work = _work(config, done, gaussians)
        self.ahead = self.work[::-1].cumsum()[::-1] - self.work
        self.recent: collections.deque[float] = collections.deque(maxlen=TIMED_STEPS)
        self.last = time.monotonic()

    def __call__(self, step: int) -> float | None:
        """Seconds left after a step; must be called after every step. None until a step has been timed."""
        now, index = time.monotonic(), step - self.done - 1
        if step not in self.compiled:
            self.recent.append((now - self.last) / self.work[index])
        self.last = now
        return float(statistics.median(self.recent) * self.ahead[index]) if self.recent else None


def _work(config: Config, done: int, gaussians: int) -> Float[np.ndarray, " S"]:
    """Relative work of each step after the first `done`, in an arbitrary unit."""
    work = np.empty(config.steps - done)
    for step in range(done + 1, config.steps + 1):
        fine = step > config.coarse_steps
        work[step - done - 1] = (FINE_STEP if fine else 1) * (FIXED_COST + gaussians)
        left = engine.growths_left(step - config.coarse_steps if fine else step, fine, config)
        if config.density.method == "mcmc" and left:
            most = int(config.density.max_gaussians)
            gaussians = int(relocation.population(jnp.asarray(gaussians), most, left))
    return work
