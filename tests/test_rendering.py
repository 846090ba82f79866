import itertools
import threading

import finished_run
import numpy as np
import pytest

from l2dgs_jax.rendering import in_order
from l2dgs_jax.visualize import view


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.getbasetemp()


def test_welllit_is_the_whole_outputs_and_grows_its_buffer(base):
    run = finished_run.opened(base)
    camera = view(run.dataset.test.cameras, 0)
    whole, short = run.renderer(), run.renderer()
    short.pair_capacity = 8
    np.testing.assert_allclose(short.welllit(camera), whole(camera).images.welllit, atol=1e-6)
    assert short.pair_capacity > 8


def test_results_come_in_order_though_computed_at_once():
    second_began = threading.Event()

    def work(i):
        if i == 0:
            assert second_began.wait(10)  # only another thread can end this wait
        second_began.set()
        return i * i

    assert list(in_order(work, range(9))) == [i * i for i in range(9)]
    assert list(in_order(work, [])) == []


def test_an_endless_series_is_read_only_a_little_ahead():
    taken = []
    results = in_order(lambda i: i, (taken.append(i) or i for i in itertools.count()))
    assert [next(results) for _ in range(5)] == list(range(5))
    assert len(taken) <= 5 + 2


def test_an_error_reaches_the_caller():
    with pytest.raises(ZeroDivisionError):
        list(in_order(lambda i: 1 / i, [1, 0, 2]))
