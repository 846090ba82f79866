import itertools
import threading

import pytest

from l2dgs_jax.runtime.prefetch import prefetch


def test_results_come_in_order_though_computed_concurrently():
    second_began = threading.Event()

    def work(i):
        if i == 0:
            assert second_began.wait(10)  # only another thread can end this wait
        second_began.set()
        return i * i

    assert list(prefetch(work, range(9))) == [i * i for i in range(9)]
    assert list(prefetch(work, [])) == []


def test_an_endless_iterator_is_read_only_a_little_ahead():
    taken = []
    results = prefetch(lambda i: i, (taken.append(i) or i for i in itertools.count()))
    assert [next(results) for _ in range(5)] == list(range(5))
    assert len(taken) <= 5 + 2


def test_an_error_reaches_the_caller():
    with pytest.raises(ZeroDivisionError):
        list(prefetch(lambda i: 1 / i, [1, 0, 2]))


def test_threads_end_with_an_iterator_that_is_closed_early():
    before = set(threading.enumerate())
    results = prefetch(lambda i: i, itertools.count())
    next(results)
    assert set(threading.enumerate()) - before
    results.close()
    assert not set(threading.enumerate()) - before
