"""Settings survive being written down."""

import pytest

from l2dgs_jax.config import PRESETS, from_dict, to_dict


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_survive_json(preset):
    assert from_dict(to_dict(PRESETS[preset])) == PRESETS[preset]
