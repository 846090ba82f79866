"""SIGINT and SIGTERM as a request that a long computation looks at between its steps."""

import contextlib
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator

STOPPING = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def stop_requests(notice: Callable[[], None]) -> Iterator[Callable[[], int | None]]:
    """A function that says which signal, if any, has asked the block to stop; a SIGINT after it ends the process.

    Signals that the process ignores, as shells have it for what runs in the background, stay ignored. Only the main
    thread can enter.

    Args:
        notice: called once, when the first signal arrives, from a thread of its own.
    """
    received: list[int] = []
    listening, arriving = socket.socketpair()
    arriving.setblocking(False)

    def listen() -> None:
        """Unlike a handler, this thread acts at once even if the main one is deep in a compilation."""
        while number := listening.recv(1):
            (signal_number,) = number
            if received and signal_number == signal.SIGINT:
                os._exit(128 + signal_number)
            if not received:
                received.append(signal_number)
                notice()

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    descriptor = signal.set_wakeup_fd(arriving.fileno(), warn_on_full_buffer=False)
    heeded = [number for number in STOPPING if signal.getsignal(number) != signal.SIG_IGN]
    # Python wakes the thread for signals that have a handler of Python's, even one that does nothing.
    previous = {number: signal.signal(number, lambda *_: None) for number in heeded}
    try:
        yield lambda: received[0] if received else None
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler or signal.SIG_DFL)  # None: it was not set from Python
        signal.set_wakeup_fd(descriptor)
        arriving.close()
        listener.join()
        listening.close()
