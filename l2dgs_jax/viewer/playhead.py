"""The instant to show while a scene is played."""

import time
from typing import NamedTuple


class Playhead(NamedTuple):
    """The instant at which playing began, and when.

    Attributes:
        instant: of the scene, in [0, 1].
        begun: time at which playing began there, seconds of `time.monotonic`.
    """

    instant: float
    begun: float

    @classmethod
    def now(cls, instant: float) -> "Playhead":
        """A playhead that starts at `instant` now."""
        return cls(instant, time.monotonic())

    def at(self, clock: float, duration: float, loop: bool) -> tuple[float, bool]:
        """The instant to show and whether playing goes on.

        Args:
            clock: present time, seconds of `time.monotonic`.
            duration: seconds from the first instant of the scene to the last.
            loop: whether to start again after the last instant.
        """
        instant = self.instant + (clock - self.begun) / duration
        if loop:
            return instant % 1.0, True
        return min(instant, 1.0), instant < 1.0
