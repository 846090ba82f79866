"""`fit`: from a data set to a run, without files."""

import dataclasses
from unittest.mock import Mock

import jax.numpy as jnp
import numpy as np
import pytest
from scenes import write_nerfies
from tiny_training import assert_equal_states, make_dataset, tiny

from l2dgs_jax.cameras.flow import MIN_SIDES, brightened, optical_flow
from l2dgs_jax.config import PRESETS, overrides
from l2dgs_jax.data import load_dataset
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs import Checkpoint, checkpoints, fit, open_run, save_run
from l2dgs_jax.runtime import devices
from l2dgs_jax.training import engine, initial_state, resolve
from l2dgs_jax.training.state import StepReport


@pytest.fixture
def dataset():
    return make_dataset()


@pytest.fixture
def quick(monkeypatch):
    """Steps that only count."""

    def train_steps(states, batches, values, number, **_):
        return states._replace(step=states.step + 1), StepReport(*[jnp.zeros(1)] * 6), engine.Tally(0, 1)

    monkeypatch.setattr(engine, "train_steps", train_steps)


def test_every_step_is_reported_and_the_run_has_the_last_state(dataset, quick):
    seen = []
    config = tiny(coarse_steps=2, fine_steps=3, density=PRESETS["default"].density)
    run = fit(dataset, config, lambda progress: seen.append(int(devices.member(progress.states, 0).step)))
    assert seen == [1, 2, 3, 4, 5]
    assert run.state.step == 5
    assert run.moving
    assert run.folder is None
    assert run.name == "tiny"


def test_a_training_goes_on_from_a_state(dataset, quick):
    config = resolve(tiny(coarse_steps=2, fine_steps=3, density=PRESETS["default"].density), dataset)
    state = initial_state(dataset, config)._replace(step=jnp.int32(4))
    seen = []
    assert fit(dataset, config, seen.append, start=Checkpoint(state, 2048)).state.step == 5
    assert [progress.step for progress in seen] == [5]
    assert seen[0].pair_capacity == 2048
    finished = state._replace(step=jnp.int32(5))
    assert fit(dataset, config, start=Checkpoint(finished, 2048)).state is finished


@pytest.mark.parametrize("decomposition", ["none", "curve"])
def test_without_a_decomposition_there_are_no_exponents(dataset, decomposition):
    model = dataclasses.replace(PRESETS["default"].model, decomposition=decomposition, tracks=False, surfaces=False)
    config = resolve(tiny(model=model), dataset)
    assert config.model.initial_exponents is None
    assert initial_state(dataset, config).scene.params.curves is not None or decomposition == "none"


def test_black_frames_are_refused(dataset):
    black = dataclasses.replace(dataset.train, images=np.zeros_like(dataset.train.images))
    with pytest.raises(UserError, match="tiny: all its training frames are black"):
        resolve(tiny(), dataclasses.replace(dataset, train=black))


def test_frames_without_a_valid_pixel_are_refused(dataset):
    transparent = dataclasses.replace(dataset.train, valid=np.zeros(dataset.train.images.shape[:3], bool))
    with pytest.raises(UserError, match="tiny: all its training frames are black or transparent; expected"):
        resolve(tiny(), dataclasses.replace(dataset, train=transparent))


@pytest.mark.parametrize("size", [(8, 11), (7, 12)])
def test_frames_too_small_for_optical_flow_are_refused(size):
    height, width = size
    small = make_dataset(width=width, height=height)
    with pytest.raises(UserError, match=f"^tiny: frames of {width}x{height} pixels are too small for optical flow"):
        resolve(tiny(inbetweens=0.1), small)
    resolve(tiny(), small)
    with pytest.raises(UserError, match=f"^frames of {width}x{height} pixels are too small"):
        optical_flow(*brightened(small.train.images)[:2])


def test_the_smallest_frames_have_optical_flow():
    small = make_dataset(width=MIN_SIDES[1], height=MIN_SIDES[0])
    resolve(tiny(inbetweens=0.1), small)
    assert np.isfinite(optical_flow(*brightened(small.train.images)[:2])).all()


def test_points_behind_all_cameras_are_refused(dataset):
    with pytest.raises(UserError, match=r"tiny: no point lies in front of a camera; expected .* axis convention"):
        resolve(tiny(), dataclasses.replace(dataset, points=-dataset.points))


@pytest.mark.parametrize(
    ("views", "side", "found"),
    [(3, 50, 1_500), (28, 50, 2_500), (80, 50, 3_750), (3, 1_000, 360_000)],
)
def test_automatic_max_gaussians_follows_pixels_and_views_up_to_a_bound(dataset, views, side, found):
    frames = np.full((views, side, side, 3), 0.1, np.float16)
    large = dataclasses.replace(dataset, train=dataclasses.replace(dataset.train, images=frames))
    config = overrides.replace(tiny(), {"density.max_gaussians": "auto"})
    assert resolve(config, large).density.max_gaussians == found


@pytest.mark.parametrize(("cameras", "cells"), [(1, None), (3, 2)])
def test_the_resolution_of_time_is_that_of_instants(dataset, cameras, cells):
    count = len(dataset.train.names)
    rig = dataset.train.cameras._replace(time=np.floor(np.arange(count) / cameras).astype(np.float32) / count)
    config = overrides.replace(tiny(), {"model.time_size": None})
    dataset = dataclasses.replace(dataset, train=dataclasses.replace(dataset.train, cameras=rig))
    assert resolve(config, dataset).model.time_size == cells


def test_automatic_settings_are_derived_from_the_data(dataset, quick):
    automatic = {"model.initial_exponents": ("auto", 9.0), "model.initial_illumination": "auto"}
    automatic |= {"loss.exposure_level": "auto", "model.domain": "auto", "model.tone": "auto"}
    run = fit(dataset, overrides.replace(tiny(coarse_steps=1, fine_steps=0), automatic))
    exponent, _ = run.config.model.initial_exponents
    assert 1 < exponent <= 2
    assert 0 < run.config.model.initial_illumination < 1
    assert 0.3 < run.config.loss.exposure_level <= 0.46
    assert (run.config.model.domain, run.config.model.tone) in (("light", "linear-light"), ("values", "gain"))
    assert not run.moving


def test_impossible_counts_of_devices_or_steps_are_refused(dataset):
    with pytest.raises(ValueError, match="devices are wanted"):
        fit(dataset, tiny(batch_size=64), device_count=64)
    for count in (0, 3):
        with pytest.raises(ValueError, match=f"device_count is {count}; expected a divisor of the batch size, 2"):
            fit(dataset, tiny(), device_count=count)
    with pytest.raises(UserError, match="at least one step"):
        fit(dataset, tiny(coarse_steps=0, fine_steps=0))


def test_a_run_renders_views_of_any_size(dataset, quick):
    run = fit(dataset, tiny(coarse_steps=1, fine_steps=1, density=PRESETS["default"].density))
    camera = dataset.test.camera(2)
    view = run.render(camera)
    assert view.images.welllit.shape == (dataset.height, dataset.width, 3)
    wide = run.render(camera, dataset.width + 8, dataset.height)
    with pytest.raises(ValueError, match="both numbers, or neither"):
        run.render(camera, width=dataset.width + 8)
    assert wide.alpha.shape == (dataset.height, dataset.width + 8)
    assert np.abs(wide.alpha[:, : dataset.width] - view.alpha).mean() < 0.02
    assert run.renderer() is run.renderer(dataset.width, dataset.height)


def test_a_saved_run_is_opened_unchanged(tmp_path, quick, monkeypatch):
    scene = write_nerfies(tmp_path / "scene", 8, 24, 18, num_points=12)
    dataset = load_dataset(scene, downscale=2, held_out="3")
    config = tiny(coarse_steps=2, fine_steps=2, density=PRESETS["default"].density)
    run = fit(dataset, config)
    assert (run.config.downscale, run.config.held_out) == (2, "3")
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "save", Mock(side_effect=OSError(28, "No space left on device")))
        with pytest.raises(UserError, match="expected more room"):
            save_run(run, tmp_path / "run")
    saved = save_run(run, tmp_path / "run")
    assert saved.folder == tmp_path / "run"
    reopened = open_run(tmp_path / "run")
    assert reopened.config == run.config
    assert_equal_states(reopened.state, run.state)
    assert reopened.dataset.test.names == dataset.test.names
    with pytest.raises(UserError, match="exists already"):
        save_run(run, tmp_path / "run")


def test_a_run_that_was_not_read_from_a_scene_cannot_be_saved(dataset, tmp_path, quick):
    run = fit(dataset, tiny(coarse_steps=1, fine_steps=0, density=PRESETS["default"].density))
    with pytest.raises(UserError, match="tiny: was not read from a scene"):
        save_run(run, tmp_path / "run")


def test_halved_rates_hold_in_the_fine_stage(dataset, quick):
    config = resolve(tiny(coarse_steps=2, fine_steps=2, density=PRESETS["default"].density), dataset)
    rates = []
    start = Checkpoint(initial_state(dataset, config)._replace(step=jnp.int32(2)), 2048, halvings=2)
    run = fit(dataset, config, lambda progress: rates.append(progress.states.adam.schedules), start=start)
    assert run.config == config
    assert rates
    for name, schedule in start.state.adam.schedules.items():
        assert rates[0][name].start == 0.25 * schedule.start
        assert rates[0][name].end == 0.25 * schedule.end
