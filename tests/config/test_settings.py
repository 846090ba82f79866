"""Settings as dictionaries."""

import pytest

from l2dgs_jax.config import PRESETS, from_dict, to_dict


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_survive_conversion_to_a_dictionary(preset):
    assert from_dict(to_dict(PRESETS[preset])) == PRESETS[preset]
