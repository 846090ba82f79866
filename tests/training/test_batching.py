import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from l2dgs_jax.training.batching import view_indices

sizes = st.integers(1, 7)


@settings(deadline=None)
@given(seed=st.integers(-5, 2**40), batch_size=sizes, num_frames=sizes, epochs=st.integers(1, 3))
def test_every_epoch_visits_every_frame_once(seed, batch_size, num_frames, epochs):
    steps = epochs * batch_size  # steps * num_frames steps end exactly at the end of an epoch
    order = np.concatenate([view_indices(seed, step, batch_size, num_frames) for step in range(steps * num_frames)])
    for epoch in order.reshape(-1, num_frames):
        assert sorted(epoch) == list(range(num_frames))


@given(seed=st.integers(0, 100), step=st.integers(0, 10**6), num_frames=st.integers(1, 50))
def test_a_resumed_run_sees_the_same_views(seed, step, num_frames):
    singles = [view_indices(seed, 2 * step + i, 1, num_frames)[0] for i in range(2)]
    assert np.array_equal(view_indices(seed, step, 2, num_frames), singles)


def test_the_order_depends_on_seed_and_epoch():
    orders = {tuple(view_indices(seed, epoch, 20, 20)) for seed in range(3) for epoch in range(3)}
    assert len(orders) == 9
