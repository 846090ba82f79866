"""The settings in a run's folder, which people edit."""

import json
import re

import pytest
from tiny_training import tiny

from l2dgs_jax import runs
from l2dgs_jax.errors import UserError


@pytest.fixture
def folder(tmp_path):
    runs.write_settings(tmp_path, "/scenes/a", tiny())
    return tmp_path


def edit(folder, change):
    content = json.loads((folder / runs.SETTINGS).read_text())
    change(content)
    (folder / runs.SETTINGS).write_text(json.dumps(content))


def test_settings_are_read_back(folder):
    assert runs.read_settings(folder) == ("/scenes/a", tiny())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: content.pop("scene"), "'scene'"),
        (lambda content: content.update(scene=3), "the scene is no name of a folder"),
        (lambda content: content["settings"].update(downscale="2"), "downscale is '2'"),
        (lambda content: content["settings"].update(held_out=8), "held_out is 8"),
        (lambda content: content["settings"]["loss"].update(gate="much"), "loss.gate is 'much'"),
        (lambda content: content["settings"].update(depth=1), "depth is not a setting"),
    ],
    ids=["no scene", "number of a scene", "text for a number", "number for text", "word for a weight", "unknown"],
)
def test_settings_of_the_wrong_type_are_named(folder, change, words):
    edit(folder, change)
    with pytest.raises(UserError, match=rf"config\.json: unreadable settings \(.*{re.escape(words)}"):
        runs.read_settings(folder)
