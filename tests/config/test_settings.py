"""Settings as dictionaries."""

import pytest

from l2dgs_jax.config import PRESETS, from_dict, overrides, to_dict
from l2dgs_jax.errors import UserError


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_survive_conversion_to_a_dictionary(preset):
    assert from_dict(to_dict(PRESETS[preset])) == PRESETS[preset]


@pytest.mark.parametrize("preset", PRESETS)
def test_the_numbers_of_presets_are_in_range(preset):
    PRESETS[preset].check()


@pytest.mark.parametrize(
    ("name", "wrong", "right"),
    [
        ("batch_size", [0], [1]),
        ("downscale", [0, -2], [1]),
        ("density.interval", [0], [1]),
        ("density.start", [], [-5]),
        ("density.stop", [], [-5]),
        ("loss.exposure_window", [0], [1, None]),
        ("seed", [-1, 2**31], [0, 2**31 - 1]),
        ("inbetweens", [-0.1, 1.0, float("nan")], [0.0, 0.9]),
        ("drop", [-0.1, 1.0], [0.0, 0.9]),
        ("optim.cooldown", [-0.1, 1.1], [0.0, 1.0]),
        ("model.shut_gates", [-0.1, 1.0], [0.0, 0.9]),
        ("model.plane_size", [1], [2]),
        ("model.time_size", [1], [2, None]),
        ("model.box_points", [0.0, 1.1], [0.01, 1.0]),
        ("model.box_rim", [-0.1, 1.0], [0.0, 0.9]),
        ("model.initial_opacity", [0.0, 1.0], [0.5]),
        ("model.sh_degree", [-1, 4], [0, 3]),
        ("model.tone", [1.0, 10.0], [1.01, "gain"]),
        ("model.initial_exponents", [(1.0, 9.0), ("auto", 10.0)], [("auto", 9.0), None]),
        ("frame_memory", [float("inf"), float("nan")], [0.0]),
        ("density.grad_threshold", [float("inf"), float("nan")], [0.0]),
    ],
)
def test_numbers_out_of_range_are_refused(name, wrong, right):
    base = overrides.replace(PRESETS["default"], {"model.domain": "values"})
    for value in wrong:
        with pytest.raises(UserError, match=f"^--{name.replace('_', '-')} .*expected"):
            overrides.replace(base, {name: value}).check()
    for value in right:
        overrides.replace(base, {name: value}).check()
