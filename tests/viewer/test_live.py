"""Viewing a training while it runs."""

import contextlib

import finished_run
import jax
import numpy as np
import pytest

from l2dgs_jax.model import rendering
from l2dgs_jax.training import Progress
from l2dgs_jax.viewer import live
from l2dgs_jax.viewer.server import Server


class Audience:
    """A stand-in for the server: the steps that it was told to show."""

    def __init__(self):
        self.steps, self.watched, self.port = [], True, None

    @contextlib.contextmanager
    def serve(self, run, host, port, share):
        self.show(run.state)
        self.port = port
        yield Server(port + 1, lambda: self.watched, self.show)
        self.port = None

    def show(self, state):
        self.steps.append(int(state.step))


@pytest.fixture
def audience(monkeypatch):
    audience = Audience()
    monkeypatch.setattr(live, "serve", audience.serve)
    return audience


@pytest.fixture
def clock(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(live.time, "monotonic", lambda: clock[0])
    return clock


def test_states_are_shown_from_the_fine_stage_on_at_intervals_while_watched(tmp_path, audience, clock):
    run, ports = finished_run.opened(tmp_path), []

    def step(number):
        state = run.state._replace(step=np.int32(number))
        clock[0] += 0.75 * live.LEAST_INTERVAL
        on_step(Progress(number, jax.tree.map(lambda x: jax.numpy.asarray(x)[None], state), None, 1024))

    with live.live(run.dataset, run.config, "127.0.0.1", 8080, ports.append) as on_step:
        for number in range(1, run.config.coarse_steps + 1):
            step(number)
        assert not ports
        first = run.config.coarse_steps + 1
        for number in range(first, first + 5):
            step(number)
        assert audience.steps == [first, first + 2, first + 4]
        assert ports == [8081]
        audience.watched = False
        step(first + 9)
        step(first + 10)
        assert audience.steps[-1] == first + 4
    assert audience.port is None


def test_a_later_state_is_rendered_without_another_compilation(tmp_path):
    run = finished_run.opened(tmp_path)
    camera = run.dataset.train.camera(0)
    run.renderer().pair_capacity *= 2  # as if a view had not fitted
    before = run.render(camera)
    opacities = run.state.scene.params.gaussians.logit_opacities - 2
    gaussians = run.state.scene.params.gaussians._replace(logit_opacities=opacities)
    scene = run.state.scene._replace(params=run.state.scene.params._replace(gaussians=gaussians))
    later = run.later(run.state._replace(scene=scene, step=run.state.step + 1))
    assert later.renderer().pair_capacity == run.renderer().pair_capacity
    compiled = rendering._render._cache_size()
    assert later.render(camera).alpha.mean() < before.alpha.mean()
    assert rendering._render._cache_size() == compiled
