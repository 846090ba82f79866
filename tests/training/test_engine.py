"""The training step and loop on a tiny scene: gradients, resuming, growing, refusing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_training import FRAMES, HEIGHT, WIDTH, assert_equal_states, batch_of, finish, make_dataset, state_of, tiny

from l2dgs_jax.config import DensityConfig
from l2dgs_jax.model.rendering import Renderer
from l2dgs_jax.runs import checkpoints
from l2dgs_jax.runs.checkpoints import Checkpoint
from l2dgs_jax.runtime.capacity import next_capacity
from l2dgs_jax.training import engine, initial_state, losses, objective, step
from l2dgs_jax.training.batching import load_batch
from l2dgs_jax.training.state import with_capacity
from l2dgs_jax.types import Camera


@pytest.fixture(scope="module")
def dataset():
    return make_dataset()


def train_step(state, batch, config, moving):
    """A step of one scene, compiled; the state stays valid."""
    return jax.jit(step.train_step, static_argnames=("config", "moving", "pair_capacity"))(
        state, batch, config, moving=moving, pair_capacity=4096
    )


@pytest.fixture(scope="module")
def finished(dataset):
    return finish(dataset, tiny())


def objective_of(dataset, config, moving):
    """The whole objective as a function of the parameters, away from the special initial values."""
    state = initial_state(dataset, config)._replace(step=jnp.asarray(config.sh_warmup, jnp.int32))
    jitter = lambda x, key: x + 0.03 * jax.random.normal(jax.random.key(key), x.shape, x.dtype)
    leaves, treedef = jax.tree.flatten(state.scene.params)
    params = treedef.unflatten([jitter(x, key) for key, x in enumerate(leaves)])
    # With random weights, OCD-Net's last ReLU may start dead, and the objective would not depend on it.
    params = params._replace(ocd=params.ocd._replace(out=params.ocd.out._replace(bias=params.ocd.out.bias + 1)))
    batch = batch_of(dataset.train, [1, 4])
    probe = jnp.zeros((2, state.scene.alive.shape[0], 2))

    def value(params, probe):
        return objective.objective(params, probe, state, batch, config, moving, 4096)[0]

    return jax.jit(jax.value_and_grad(value, argnums=(0, 1))), params, probe


def random_like(tree, mask, key):
    """Normal noise where `mask` is True, zeros elsewhere."""
    leaves, treedef = jax.tree.flatten(tree)
    keys = jax.random.split(key, len(leaves))
    drawn = [
        jax.random.normal(k, x.shape) if use else jnp.zeros_like(x)
        for k, x, use in zip(keys, leaves, jax.tree.leaves(mask), strict=True)
    ]
    return treedef.unflatten(drawn)


@pytest.mark.parametrize(
    ("preset", "moving"),
    [("paper", True), pytest.param("authors", True, marks=pytest.mark.slow), ("default", True), ("paper", False)],
)
def test_the_gradient_of_the_whole_objective_matches_finite_differences(dataset, preset, moving):
    value_and_grad, params, probe = objective_of(dataset, tiny(preset), moving)
    value = lambda params: value_and_grad(params, probe)[0]
    gradient = value_and_grad(params, probe)[1]
    parts = {
        "gaussians": lambda p: p.gaussians,
        "hexplane": lambda p: p.hexplane,
        "heads": lambda p: p.heads,
        "ocd": lambda p: p.ocd,
        "bafe": lambda p: p.bafe,
    }
    for index, (name, part) in enumerate(parts.items()):
        mask = jax.tree.map(lambda _: False, params)._replace(**{name: jax.tree.map(lambda _: True, part(params))})
        direction = random_like(params, mask, jax.random.key(index))
        slope = sum(jnp.vdot(g, d) for g, d in zip(*map(jax.tree.leaves, (gradient[0], direction)), strict=True))
        differences = []
        for size in (1e-6, 5e-7):
            ahead, behind = (
                value(jax.tree.map(lambda p, d, s=sign * size: p + s * d, params, direction)) for sign in (1, -1)
            )
            differences.append((ahead - behind) / (2 * size))
        scale = max(abs(float(slope)), 1e-4)
        assert min(abs(float(slope - d)) for d in differences) < 2e-3 * scale, (name, slope, differences)
        if name in ("gaussians", "bafe") or moving:
            assert slope != 0, name


def test_the_probe_gradient_is_the_gradient_by_screen_positions(dataset):
    value_and_grad, params, probe = objective_of(dataset, tiny("paper"), False)
    slope = value_and_grad(params, probe)[1][1]
    direction = jax.random.normal(jax.random.key(0), probe.shape)
    ahead, behind = (value_and_grad(params, probe + sign * 1e-6 * direction)[0] for sign in (1, -1))
    np.testing.assert_allclose((ahead - behind) / 2e-6, jnp.vdot(slope, direction), rtol=2e-3)


def test_nothing_is_learned_from_pixels_outside_the_valid_mask(dataset):
    config = tiny()
    valid = np.random.default_rng(0).random((FRAMES, HEIGHT, WIDTH)) < 0.7
    estimate = jax.random.uniform(jax.random.key(0), (2, HEIGHT, WIDTH, 3))
    states, compared = [], []
    for wrong in (0.0, 1.0):
        images = np.where(valid[..., None], dataset.train.images, wrong).astype(np.float16)
        split = dataclasses.replace(dataset.train, images=images, valid=valid)
        states.append(initial_state(dataclasses.replace(dataset, train=split), config))
        batch = load_batch(split, np.array([1, 4]))
        batch = batch._replace(images=jnp.asarray(batch.images, float))
        compared.append(objective.compared(batch, estimate))

        def photometric(estimate, batch=batch):
            prediction, target, _ = objective.compared(batch, estimate)
            l1 = losses.photometric_l1(prediction, target, "raw", 1.0, 0.01)
            return l1 + losses.photometric_ssim(prediction, target, 1.0, 0.01)

        gradient = jax.grad(photometric)(estimate)
        assert jnp.all(gradient[~batch.valid] == 0)
        assert jnp.all(gradient[batch.valid] != 0)
    assert_equal_states(*states)
    assert_equal_states(*compared)
    prediction, target, share = compared[0]
    seen = valid[[1, 4]]
    np.testing.assert_array_equal(prediction, estimate)
    np.testing.assert_array_equal(target[~seen], estimate[~seen])
    np.testing.assert_array_equal(target[seen], dataset.train.images[[1, 4]][seen])
    np.testing.assert_allclose(share, seen.mean())


def test_a_step_measures_only_the_pixels_of_the_valid_mask(dataset):
    config = tiny()
    state = initial_state(dataset, config)
    probe = jnp.zeros((2, state.scene.alive.shape[0], 2))
    batch = batch_of(dataset.train, [1, 4])
    half = jnp.arange(WIDTH) < WIDTH // 2
    report = jax.jit(
        lambda valid: objective.objective(
            state.scene.params, probe, state, batch._replace(valid=valid), config, False, 4096
        )[1][0]
    )
    masks = [jnp.broadcast_to(mask, (2, HEIGHT, WIDTH)) for mask in (half | True, half, ~half)]
    whole, left, right = (10 ** (-report(mask).psnr / 10) for mask in masks)
    np.testing.assert_allclose(whole, (left + right) / 2, rtol=1e-9)  # MSE of the halves, averaged
    assert not np.isclose(left, right)


def test_saturated_pixels_do_not_count_for_exposure_control(dataset):
    config = tiny()
    state = initial_state(dataset, config)
    probe = jnp.zeros((2, state.scene.alive.shape[0], 2))
    batch = batch_of(dataset.train, [1, 4])
    half = jnp.broadcast_to(jnp.arange(WIDTH) < WIDTH // 2, (2, HEIGHT, WIDTH))
    lamps = jnp.where(half[..., None], batch.images, jnp.array([0.5, 1, 0.5]))
    exposure = jax.jit(
        lambda batch: objective.objective(state.scene.params, probe, state, batch, config, False, 4096)[1][0].terms[
            "exposure"
        ]
    )
    alone = exposure(batch._replace(valid=half))
    np.testing.assert_allclose(exposure(batch._replace(images=lamps)), alone, rtol=1e-9)
    np.testing.assert_allclose(exposure(batch._replace(images=lamps, valid=half)), alone, rtol=1e-9)
    assert not np.isclose(exposure(batch), alone)


def test_training_lowers_the_loss_and_adds_gaussians(dataset):
    config = tiny(coarse_steps=40, fine_steps=0)
    member = engine.Member(dataset.train, config, initial_state(dataset, config))
    reports = [(float(p.report.loss[0]), int(p.states.scene.alive.sum())) for p in engine.run([member])]
    losses, counts = zip(*reports, strict=True)
    assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:5])
    assert counts[-1] == 60 > counts[0] == 25


def test_a_resumed_run_equals_the_uninterrupted_one(dataset, finished, tmp_path):
    config = tiny()
    for stop_step in (3, 4, 6):
        member = engine.Member(dataset.train, config, initial_state(dataset, config))
        for progress in engine.run([member]):
            if progress.step == stop_step:
                saved = Checkpoint(state_of(progress), progress.pair_capacity)
                checkpoints.save(tmp_path / "c.npz", saved, config)
                break
        state, pair_capacity, _ = checkpoints.load(tmp_path / "c.npz", config, FRAMES)
        assert int(state.step) == stop_step
        assert_equal_states(finish(dataset, config, state, pair_capacity).states, finished.states)


def test_a_small_pair_buffer_grows_without_changing_the_result(dataset, finished):
    small = finish(dataset, tiny(), pair_capacity=8)
    assert small.pair_capacity > 8
    for x, y in zip(*map(jax.tree.leaves, (small.states.scene, finished.states.scene)), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_each_stage_compiles_once_and_dead_rows_change_nothing(dataset):
    config = tiny(density=DensityConfig(start=1000))
    compiled = engine.train_steps._cache_size()
    plain = state_of(finish(dataset, config, pair_capacity=8192))
    assert engine.train_steps._cache_size() == compiled + 2
    wide = state_of(finish(dataset, config, with_capacity(initial_state(dataset, config), 2000), 8192))
    rows = plain.scene.alive.shape[0]
    for x, y in zip(*map(jax.tree.leaves, (plain.scene.params.gaussians, wide.scene.params.gaussians)), strict=True):
        np.testing.assert_allclose(x, y[:rows], rtol=1e-6, atol=1e-9)
        np.testing.assert_array_equal(y[rows:], 0)


def test_the_first_pair_buffer_fits_the_first_views(dataset):
    config = tiny()
    scene = with_capacity(initial_state(dataset, config), 1500).scene
    gaussians = scene.params.gaussians
    image_filling = gaussians._replace(
        means=jnp.zeros_like(gaussians.means).at[:, 2].set(2), log_scales=jnp.ones_like(gaussians.log_scales)
    )
    scene = scene._replace(params=scene.params._replace(gaussians=image_filling))
    tiles = 2 * 2
    for alive in (1000, 1500):
        scene = scene._replace(alive=jnp.arange(1500) < alive)
        capacity = engine.first_capacity(dataset.train, scene, config.batch_size)
        assert capacity == next_capacity(1.3 * alive * tiles * config.batch_size)


def test_the_fine_stage_initially_renders_what_the_coarse_one_does(dataset):
    config = tiny()
    state = initial_state(dataset, config)
    camera = Camera(*(x[2] for x in dataset.train.cameras))
    coarse, fine = (
        Renderer(state.scene, config.model, WIDTH, HEIGHT, moving=moving, sh_degree=1)(camera)
        for moving in (False, True)
    )
    np.testing.assert_allclose(coarse.images.lowlight, fine.images.lowlight, atol=1e-12)


def test_a_step_with_a_nan_changes_nothing_and_stops_the_run(dataset):
    config = tiny()
    images = dataset.train.images.copy()
    images[:, 0, 0] = np.nan
    state = initial_state(dataset, config)
    batch = load_batch(dataclasses.replace(dataset.train, images=images), np.array([0, 1]))
    after, report = train_step(state, batch, config, moving=False)
    assert not report.finite
    assert_equal_states(after, state)
    with pytest.raises(engine.DivergedError, match="step 0"):
        finish(dataclasses.replace(dataset, train=dataclasses.replace(dataset.train, images=images)), config)


@pytest.mark.slow
def test_vmap_over_scenes_equals_a_loop(dataset):
    config = tiny()
    datasets = [dataset, make_dataset(1)]
    states = [initial_state(d, config) for d in datasets]
    batches = [load_batch(d.train, np.array([0, 3])) for d in datasets]
    stack = lambda trees: jax.tree.map(lambda *x: jnp.stack([jnp.asarray(v) for v in x]), *trees)
    take_step = lambda state, batch: train_step(state, batch, config, moving=True)
    together, reports = jax.vmap(take_step)(stack(states), stack(batches))
    for index, (state, batch) in enumerate(zip(states, batches, strict=True)):
        alone, report = take_step(state, batch)
        np.testing.assert_allclose(reports.loss[index], report.loss, rtol=1e-9)
        for x, y in zip(*map(jax.tree.leaves, (together, alone)), strict=True):
            # The quaternions of round Gaussians have no gradient except rounding errors, which Adam magnifies.
            np.testing.assert_allclose(x[index], y, rtol=1e-6, atol=1e-5)
