"""Gaussians that a step leaves out at random."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from tiny_training import batch_of, make_dataset, tiny

from l2dgs_jax.model.deformation import deform
from l2dgs_jax.training import initial_state, objective


@pytest.fixture(scope="module")
def state():
    dataset = make_dataset()
    return initial_state(dataclasses.replace(dataset, points=np.tile(dataset.points, (40, 1))), tiny())


def test_their_share_grows_to_the_end_of_the_run(state):
    config = tiny(drop=0.4)
    for number in (0, config.steps // 2, config.steps - 1):
        factors = np.asarray(objective.presence(state._replace(step=jnp.int32(number)), config))
        share = 0.4 * number / config.steps
        assert abs(np.mean(factors == 0) - share) < 0.05
        np.testing.assert_allclose(factors[factors > 0], 1 / (1 - share), rtol=1e-6)


def test_every_step_leaves_out_others_and_always_the_same(state):
    config = tiny(drop=0.4)
    one, again, other = (objective.presence(state._replace(step=jnp.int32(n)), config) for n in (5, 5, 6))
    np.testing.assert_array_equal(one, again)
    assert ((one == 0) != (other == 0)).any()
    assert objective.presence(state, tiny()) is None


def test_what_is_left_out_is_not_there_and_the_rest_stays_below_one(state):
    config = tiny()
    cameras = batch_of(make_dataset().train, [0, 3]).cameras
    presence = jnp.where(jnp.arange(len(state.scene.alive)) % 2 == 0, 0.0, 30.0)
    there = {"moving": False, "sh_degree_active": 0}
    plain = deform(state.scene, cameras, config.model, **there)
    moved = deform(state.scene, cameras, config.model, **there, presence=presence)
    assert not moved.opacities[:, ::2].any()
    np.testing.assert_allclose(moved.opacities[:, 1::2], np.minimum(30 * plain.opacities[:, 1::2], 1), rtol=1e-6)
