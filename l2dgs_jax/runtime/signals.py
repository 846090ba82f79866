"""SIGINT and SIGTERM as requests to stop, which a long computation checks between its steps."""

import contextlib
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def stop_requests(notice: Callable[[], None]) -> Iterator[Callable[[], int | None]]:
    """A function that returns the signal that has asked the block to stop, or None; a further SIGINT ends the process.

    Signals that the process ignores, as shells arrange for background jobs, stay ignored. Only the main thread can
    enter the block.

    Args:
        notice: called once, when the first signal arrives, from a thread of its own.
    """
    received: list[int] = []
    listening, arriving = socket.socketpair()
    arriving.setblocking(False)

    def listen() -> None:
        """Unlike a signal handler, this thread acts at once even while the main thread compiles."""
        while number := listening.recv(1):
            (signal_number,) = number
            if signal_number not in STOP_SIGNALS:  # a handler of the program around this one
                continue
            if received and signal_number == signal.SIGINT:
                os._exit(128 + signal_number)
            if not received:
                received.append(signal_number)
                notice()

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    descriptor = signal.set_wakeup_fd(arriving.fileno(), warn_on_full_buffer=False)
    heeded = [number for number in STOP_SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
    # Python writes to the wakeup descriptor only for signals with a Python handler, even one that does nothing.
    previous = {number: signal.signal(number, lambda *_: None) for number in heeded}
    try:
        yield lambda: received[0] if received else None
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler or signal.SIG_DFL)  # None: the handler was not set from Python
        signal.set_wakeup_fd(descriptor)
        arriving.close()
        listener.join()
        listening.close()
