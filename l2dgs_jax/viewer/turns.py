"""Whose picture is drawn next. What it shows is read when its turn comes: what was wanted before is never drawn."""

import threading
import time
from collections.abc import Callable
from typing import NamedTuple

INTERVAL = 1 / 30  # seconds from one picture of a guest to the next, at least
REST = 0.25  # seconds without a change after which a picture is sharpened


class Turn(NamedTuple):
    """A guest's turn.

    Attributes:
        guest: whose.
        sharpen: whether the picture is up to date and only to become sharper.
    """

    guest: int
    sharpen: bool


class Turns:
    """The turns of guests, for a thread that draws.

    First come those who wait for a picture, then those who could have a sharper one; among them whoever waits longest.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._news = threading.Condition()
        self._due: dict[int, tuple[bool, float]] = {}  # by guest: whether only to sharpen, and from when on
        self._changed: dict[int, float] = {}
        self._drawn: dict[int, float] = {}
        self._closed = False

    def ask(self, guest: int) -> None:
        """What the guest wants to see has changed."""
        with self._news:
            now = self._clock()
            self._changed[guest] = now
            if self._due.get(guest, (True, 0))[0]:
                self._due[guest] = False, max(now, self._drawn.get(guest, -1) + INTERVAL)
            self._news.notify()

    def rest(self, guest: int) -> None:
        """The guest's picture can become sharper, once nothing has changed for a while."""
        with self._news:
            if guest in self._changed:
                self._due.setdefault(guest, (True, self._changed[guest] + REST))
            self._news.notify()

    def leave(self, guest: int) -> None:
        """The guest has gone."""
        with self._news:
            for facts in (self._due, self._changed, self._drawn):
                facts.pop(guest, None)

    def close(self) -> None:
        """There are no more turns."""
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
        """The turn that is due, or else the seconds until one will be, if anybody waits."""
        if not self._due:
            return None, None
        now = self._clock()
        ready = {guest: due for guest, due in self._due.items() if due[1] <= now}
        if not ready:
            return None, min(since for _, since in self._due.values()) - now
        guest = min(ready, key=ready.__getitem__)
        self._drawn[guest] = now
        return Turn(guest, self._due.pop(guest)[0]), None
