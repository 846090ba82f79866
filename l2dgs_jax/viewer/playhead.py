"""Time as it runs while a scene is played."""

import time
from typing import NamedTuple


class Playhead(NamedTuple):
    """Where playing began.

    Attributes:
        instant: of the scene, in [0, 1].
        begun: when that was shown, seconds of the clock.
    """

    instant: float
    begun: float

    @classmethod
    def now(cls, instant: float) -> "Playhead":
        """Playing from `instant` on."""
        return cls(instant, time.monotonic())

    def at(self, clock: float, duration: float, loop: bool) -> tuple[float, bool]:
        """The instant to show and whether playing goes on.

        Args:
            clock: seconds of the clock.
            duration: seconds from the first instant of the scene to the last.
            loop: whether the first follows on the last.
        """
        instant = self.instant + (clock - self.begun) / duration
        if loop:
            return instant % 1.0, True
        return min(instant, 1.0), instant < 1.0
