"""Exposure gains of the frames, learned together with the scene."""

import dataclasses
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from tiny_training import FRAMES, finish, make_dataset, state_of, tiny

from l2dgs_jax.config import overrides
from l2dgs_jax.model.observation import evenly_exposed, exposures
from l2dgs_jax.training import initial_state, objective, resolve
from l2dgs_jax.training.batching import load_batch

GAINS = np.linspace(-0.3, 0.3, FRAMES)


def drifting_dataset(gains=GAINS):
    """A still scene filmed from one place with changing exposure."""
    dataset = make_dataset()
    same_camera = dataset.train.cameras._replace(viewmat=dataset.train.cameras.viewmat[:1].repeat(FRAMES, 0))
    images = np.exp(gains)[:, None, None, None] * dataset.train.images[:1].clip(0.05)
    train = dataclasses.replace(dataset.train, images=images.astype(np.float16), cameras=same_camera)
    return dataclasses.replace(dataset, train=train)


def config_of(exposure, **changes):
    return overrides.replace(tiny(), {"model.exposure": exposure} | changes)


@pytest.mark.parametrize(("gains", "found"), [(GAINS, "drifting"), (0.03 * GAINS, "steady")])
def test_drifting_exposure_is_detected_from_the_frames(gains, found):
    assert resolve(config_of("auto"), drifting_dataset(gains)).model.exposure == found


def test_training_starts_from_the_gains_that_the_frames_show():
    state = initial_state(drifting_dataset(), config_of("drifting"))
    np.testing.assert_allclose(state.scene.params.exposures, np.tile(GAINS[:, None], 3), atol=0.01)
    assert initial_state(drifting_dataset(), config_of("steady")).scene.params.exposures is None


def test_exposures_that_are_undone_leave_no_drift():
    dataset = drifting_dataset()
    gains = exposures(dataset.points, dataset.train.cameras, dataset.train.images)
    even = evenly_exposed(dataset.train.images, gains).astype(np.float32)
    np.testing.assert_allclose(even, np.tile(even[:1], (FRAMES, 1, 1, 1)), rtol=0.02)


@pytest.mark.parametrize(("exposure", "even"), [("drifting", True), ("steady", False)])
def test_what_moves_is_looked_for_in_evenly_exposed_frames(exposure, even, monkeypatch):
    seen = []
    module = sys.modules["l2dgs_jax.training.initial_state"]
    monkeypatch.setattr(module, "find_seeds", lambda points, split, *_: seen.append(split.images))
    initial_state(drifting_dataset(), config_of(exposure, **{"model.tracks": True}))
    means = seen[0].astype(np.float32).mean((1, 2, 3))
    assert (np.ptp(means) < 0.02 * means.mean()) == even


def test_renderings_are_exposed_like_their_frames():
    images = jnp.full((2, 3, 4, 3), 0.2)
    log_gains = jnp.log(jnp.array([[1.0, 1, 1], [2, 4, 8], [1, 0.25, 0.125]]))
    exposed = objective.exposed(images, log_gains, jnp.array([1, 2]))
    # Relative to their geometric mean, which is [2, 1, 1]^(1/3).
    np.testing.assert_allclose(exposed[0, 0, 0], 0.2 * np.array([2, 4, 8]) / np.array([2 ** (1 / 3), 1, 1]), rtol=1e-6)
    np.testing.assert_allclose(
        exposed[1, 0, 0], 0.2 * np.array([1, 0.25, 0.125]) / np.array([2 ** (1 / 3), 1, 1]), rtol=1e-6
    )
    check_grads(lambda *x: objective.exposed(*map(jnp.asarray, x), jnp.array([1, 2])), (images, log_gains), 1)


@pytest.mark.slow
def test_training_recovers_the_gains_of_the_frames():
    dataset = drifting_dataset()
    changes = {"optim.exposures_lr": 0.02, "loss.ssim": 0.0, "coarse_steps": 100, "fine_steps": 0}
    config = config_of("drifting", **changes)
    start = initial_state(dataset, config)
    params = start.scene.params
    without_gains = params._replace(exposures=jnp.zeros_like(params.exposures))
    learned = state_of(finish(dataset, config, start._replace(scene=start.scene._replace(params=without_gains))))
    gains = np.asarray(learned.scene.params.exposures).mean(-1)
    assert np.corrcoef(gains, GAINS)[0, 1] > 0.9
    assert np.ptp(gains) > 0.3


def test_a_batch_contains_the_indices_of_its_frames():
    batch = load_batch(make_dataset().train, np.array([4, 1]))
    np.testing.assert_array_equal(batch.frames, [4, 1])
