import itertools
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2dgs_jax.data.batching import batches, view_indices

sizes = st.integers(1, 7)


@settings(deadline=None)
@given(seed=st.integers(-5, 2**40), batch_size=sizes, num_frames=sizes, epochs=st.integers(1, 3))
def test_every_epoch_shows_every_frame_once(seed, batch_size, num_frames, epochs):
    steps = epochs * batch_size  # the shortest run of steps that surely ends with an epoch
    order = np.concatenate([view_indices(seed, step, batch_size, num_frames) for step in range(steps * num_frames)])
    for epoch in order.reshape(-1, num_frames):
        assert sorted(epoch) == list(range(num_frames))


@given(seed=st.integers(0, 100), step=st.integers(0, 10**6), num_frames=st.integers(1, 50))
def test_a_resumed_run_sees_the_same_views(seed, step, num_frames):
    assert np.array_equal(view_indices(seed, step, 2, num_frames), view_indices(seed, step, 2, num_frames))
    singles = [view_indices(seed, 2 * step + i, 1, num_frames)[0] for i in range(2)]
    assert np.array_equal(view_indices(seed, step, 2, num_frames), singles)


def test_order_depends_on_seed_and_epoch():
    orders = {tuple(view_indices(seed, epoch, 20, 20)) for seed in range(3) for epoch in range(3)}
    assert len(orders) == 9


def test_batches_are_those_of_the_steps_in_order():
    found = list(batches(lambda indices: indices, range(3, 12), seed=5, batch_size=2, num_frames=7))
    assert len(found) == 9
    for step, indices in enumerate(found, start=3):
        np.testing.assert_array_equal(indices, view_indices(5, step, 2, 7))


def test_the_next_batches_are_read_while_one_is_used():
    read = [threading.Event() for _ in range(6)]
    places = {tuple(view_indices(0, step, 1, 6)): step for step in range(6)}

    def load(indices):
        step = places[tuple(indices)]
        read[step].set()
        return step

    found = batches(load, range(6), seed=0, batch_size=1, num_frames=6)
    assert next(found) == 0
    assert read[1].wait(10)  # though nobody has asked for it
    assert read[2].wait(10)
    assert not read[4].is_set()
    assert list(found) == [1, 2, 3, 4, 5]


def test_an_error_comes_in_the_place_of_its_batch_and_ends_the_threads():
    before = set(threading.enumerate())
    bad = view_indices(0, 2, 1, 6).tolist()

    def load(indices):
        if indices.tolist() == bad:
            raise OSError("gone")
        return 0

    found = batches(load, itertools.count(), seed=0, batch_size=1, num_frames=6)
    assert [next(found), next(found)] == [0, 0]
    with pytest.raises(OSError, match="gone"):
        next(found)
    assert set(threading.enumerate()) == before
