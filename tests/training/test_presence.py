"""Random dropping of Gaussians in training steps."""

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


def test_the_dropped_share_grows_until_the_end_of_the_run(state):
    config = tiny(drop=0.4)
    for number in (0, config.steps // 2, config.steps - 1):
        factors = np.asarray(objective.presence(state._replace(step=jnp.int32(number)), config))
        share = 0.4 * number / config.steps
        assert abs(np.mean(factors == 0) - share) < 0.05
        np.testing.assert_allclose(factors[factors > 0], 1 / (1 - share), rtol=1e-6)


def test_every_step_drops_other_gaussians_reproducibly(state):
    config = tiny(drop=0.4)
    one, again, other = (objective.presence(state._replace(step=jnp.int32(n)), config) for n in (5, 5, 6))
    np.testing.assert_array_equal(one, again)
    assert ((one == 0) != (other == 0)).any()
    assert objective.presence(state, tiny()) is None


def test_dropped_gaussians_are_transparent_and_other_opacities_at_most_one(state):
    config = tiny()
    cameras = batch_of(make_dataset().train, [0, 3]).cameras
    presence = jnp.where(jnp.arange(len(state.scene.alive)) % 2 == 0, 0.0, 30.0)
    options = {"moving": False, "sh_degree_active": 0}
    plain = deform(state.scene, cameras, config.model, **options)
    thinned = deform(state.scene, cameras, config.model, **options, presence=presence)
    assert not thinned.opacities[:, ::2].any()
    np.testing.assert_allclose(thinned.opacities[:, 1::2], np.minimum(30 * plain.opacities[:, 1::2], 1), rtol=1e-6)
