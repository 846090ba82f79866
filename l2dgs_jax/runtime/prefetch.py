"""Computing results a little ahead of their use, on threads."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
U = TypeVar("U")


def prefetch(function: Callable[[T], U], items: Iterable[T], workers: int = 2) -> Generator[U, None, None]:
    """`map` with a few items at once in threads, so that one item uses the cores that another leaves idle.

    At most `workers` results wait besides the next one. An error is raised where its result would have come. The
    threads end with the iterator, also when it is closed early.
    """
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[Future[U]] = deque()
        for item in items:
            waiting.append(pool.submit(function, item))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
