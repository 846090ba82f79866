"""Settings by dotted names: every one can be named, and nothing else; copies leave the original alone."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2dgs_jax.config import PRESETS, from_dict, overrides, to_dict

CONFIG = PRESETS["default"]


def flat(table, prefix=""):
    for key, value in table.items():
        yield from flat(value, f"{prefix}{key}.") if isinstance(value, dict) else [(f"{prefix}{key}", value)]


@pytest.mark.parametrize("preset", PRESETS)
def test_every_setting_takes_its_own_value(preset):
    for name, value in flat(to_dict(PRESETS[preset])):
        held = overrides.checked(name, "None" if value is None else value)
        assert overrides.replace(PRESETS[preset], {name: held}) == PRESETS[preset], name


@pytest.mark.parametrize(
    ("name", "value", "held"),
    [
        ("loss.exposure", 1, 1.0),
        ("optim.decay_steps", "None", None),
        ("model.initial_exponents", ["auto", 9], ("auto", 9.0)),
        ("model.plane_scales", [1, 2, 4], (1, 2, 4)),
        ("format", "colmap", "colmap"),
    ],
)
def test_values_are_converted(name, value, held):
    checked = overrides.checked(name, value)
    assert checked == held
    assert type(checked) is type(held)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("loss.exposure", "high"),
        ("loss.exposure", True),
        ("loss.exposure", float("nan")),
        ("loss.exposure", float("inf")),
        ("loss.exposure", 10**400),
        ("loss.exposure_of", "lamp"),
        ("model.initial_exponents", [1.5]),
        ("model.initial_exponents", [1.5, 9, 9]),
        ("batch_size", 2.5),
        ("seed", 2**40),
        ("density.conserve_opacity", 1),
        ("loss", 3),
        ("loss.nonsense", 3),
    ],
)
def test_invalid_values_and_names_are_refused(name, value):
    with pytest.raises(ValueError, match=rf"{name}.*expected") as caught:
        overrides.checked(name, value)
    assert "\n" not in str(caught.value)


@given(st.dictionaries(st.sampled_from(["loss.ssim", "loss.depth", "optim.beta1"]), st.floats(2, 900)))
def test_replaced_settings_are_the_differences(values):
    before = to_dict(CONFIG)
    changed = overrides.replace(CONFIG, values)
    assert to_dict(CONFIG) == before
    assert overrides.differences([CONFIG, changed]).keys() == values.keys()
    assert all(column[1] == values[name] for name, column in overrides.differences([CONFIG, changed]).items())
    assert overrides.outline(changed) == overrides.outline(CONFIG)
    assert from_dict(to_dict(changed)) == changed


def test_outlines_distinguish_absent_from_present_values():
    without = overrides.replace(CONFIG, {"model.initial_exponents": None})
    assert overrides.outline(without) != overrides.outline(CONFIG)
    assert hash(overrides.outline(CONFIG)) == hash(overrides.outline(overrides.replace(CONFIG, {"seed": 7})))


@given(st.dictionaries(st.sampled_from(["loss.ssim", "loss.depth", "optim.beta1", "seed"]), st.integers(2, 900)))
def test_partition_and_combine_restore_every_config(values):
    values = {name: overrides.checked(name, value) for name, value in values.items()}
    configs = [CONFIG, overrides.replace(CONFIG, values)]
    static, columns = overrides.partition(configs)
    assert set(static.holes) == columns.keys() == values.keys()
    for index, config in enumerate(configs):
        assert overrides.combine(static, {name: column[index] for name, column in columns.items()}) == config
    # Another member with other numbers is trained by the same program.
    assert overrides.partition([configs[1], configs[0]])[0] == static
    assert hash(overrides.partition([configs[1], configs[0]])[0]) == hash(static)


def test_combine_accepts_traced_numbers():
    static, _ = overrides.partition([CONFIG, overrides.replace(CONFIG, {"loss.ssim": 2.0, "seed": 3})])
    total = jax.jit(lambda values: overrides.combine(static, values).loss.ssim + CONFIG.loss.depth)
    np.testing.assert_allclose(total({"loss.ssim": 2.0, "seed": 3}), 2.001)


@pytest.mark.parametrize("values", [{}, {"loss.ssim": 1.0, "seed": 0, "loss.depth": 1.0}, {"loss.ssim": 1.0}])
def test_missing_and_superfluous_values_are_refused(values):
    static, _ = overrides.partition([CONFIG, overrides.replace(CONFIG, {"loss.ssim": 2.0, "seed": 3})])
    with pytest.raises(ValueError, match=r"expected them for \['loss.ssim', 'seed'\]"):
        overrides.combine(static, values)


def test_differences_other_than_numbers_are_refused():
    with pytest.raises(ValueError, match=r"model.hidden is \[64, 8\]; expected settings that differ in numbers only"):
        overrides.partition([CONFIG, overrides.replace(CONFIG, {"model.hidden": 8})])
