"""Which guest's picture is drawn next. Its camera is read only when its turn comes, so outdated views are not drawn."""

import threading
import time
from collections.abc import Callable
from typing import NamedTuple

LEAST_INTERVAL = 1 / 30  # seconds between two pictures of a guest
SHARPEN_AFTER = 0.25  # seconds without a change


class Turn(NamedTuple):
    """A guest's turn to get a picture.

    Attributes:
        guest: number of the guest.
        sharpen: whether the picture is up to date and should only become sharper.
    """

    guest: int
    sharpen: bool


class Turns:
    """The order in which a drawing thread serves guests.

    Guests that wait for a new picture come before those whose picture can be sharpened; within each group, the one that
    has waited longest comes first.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._news = threading.Condition()
        self._due: dict[int, tuple[bool, float]] = {}  # by guest: whether only to sharpen, and not before when
        self._changed: dict[int, float] = {}
        self._drawn: dict[int, float] = {}
        self._closed = False

    def ask(self, guest: int) -> None:
        """Request a new picture: what the guest wants to see has changed."""
        with self._news:
            now = self._clock()
            self._changed[guest] = now
            if self._due.get(guest, (True, 0))[0]:
                self._due[guest] = False, max(now, self._drawn.get(guest, -1) + LEAST_INTERVAL)
            self._news.notify()

    def rest(self, guest: int) -> None:
        """Request that the guest's picture is sharpened once nothing has changed for a while."""
        with self._news:
            if guest in self._changed:
                self._due.setdefault(guest, (True, self._changed[guest] + SHARPEN_AFTER))
            self._news.notify()

    def leave(self, guest: int) -> None:
        """Forget a guest that has disconnected."""
        with self._news:
            for facts in (self._due, self._changed, self._drawn):
                facts.pop(guest, None)

    def close(self) -> None:
        """End all turns: `take` then returns None."""
        with self._news:
            self._closed = True
            self._news.notify_all()

    def take(self) -> Turn | None:
        """Wait for the next turn; None once closed."""
        with self._news:
            while not self._closed:
                turn, wait = self.next()
                if turn:
                    return turn
                self._news.wait(wait)
        return None

    def next(self) -> tuple[Turn | None, float | None]:
        """The turn that is due, if any, or else the seconds until the next one; (None, None) if nobody waits."""
        if not self._due:
            return None, None
        now = self._clock()
        ready = {guest: due for guest, due in self._due.items() if due[1] <= now}
        if not ready:
            return None, min(since for _, since in self._due.values()) - now
        guest = min(ready, key=ready.__getitem__)
        self._drawn[guest] = now
        return Turn(guest, self._due.pop(guest)[0]), None
