"""The README and the pages of the documentation: their commands are run as printed.

Trainings are shortened: they have the options of `SHORT`, their steps only count, and they draw no pictures.
SCENE and the demo are a tiny scene, RUN and runs/demo a tiny run; and the viewer stops at once.
"""

import importlib
import re
import shlex
import shutil
from pathlib import Path

import finished_run
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import write_nerfies
from tiny_training import report

from l2dgs_jax import train, view
from l2dgs_jax.__main__ import COMMANDS
from l2dgs_jax.data import demo
from l2dgs_jax.study.spec import read
from l2dgs_jax.training import engine

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SHORT = ["--coarse-steps=0", "--fine-steps=2", "--model.plane-size=4", "--model.plane-scales=1", "--model.hidden=8"]
SHORT += ["--model.plane-channels=2", "--model.no-tracks", "--model.no-surfaces", "--inbetweens=0"]
SHORT += ["--no-report"]
# Not run: commands that install; that find poses, train studies or choose kernels, which have their own tests; and
# that need several hosts, weights that are not here, or hours.
INSTALLS = ("git ", "cd ", "pip ", "pytest", "pre-commit")
LEFT_OUT = ("prepare", "sweep", "L2DGS_JAX_KERNELS", "XLA_FLAGS", "--weights", "--lpips", "experiments")


def blocks(page, language):
    found = re.findall(rf"^( *)```{language}\n(.*?)^\1```", page.read_text(), re.S | re.M)
    return [re.sub(rf"^{indent}", "", block, flags=re.M) for indent, block in found]


def programs(page):
    """The commands of a page, split into words."""
    for block in blocks(page, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            for command in map(str.strip, line.split("&&")):
                if not command.startswith(INSTALLS) and not any(part in command for part in LEFT_OUT):
                    yield shlex.split(command, comments=True)


def test_every_command_of_the_documentation_is_one_of_the_package():
    typed = [words for page in PAGES for words in programs(page) if words]
    assert len(typed) > 25
    for python, option, module, *_ in typed:
        assert (python, option) == ("python", "-m")
        assert module.removeprefix("l2dgs_jax.") in COMMANDS


def counting_step(states, *_, **__):
    return states._replace(step=states.step + 1), report(), engine.Tally(jnp.int32(0), jnp.int32(1))


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if any(programs(page))], ids=lambda page: page.stem)
def test_the_commands_of_a_page_run(page, tmp_path_factory, tmp_path, monkeypatch):
    run = finished_run.folder(tmp_path_factory.getbasetemp() / "docs")
    monkeypatch.chdir(tmp_path)
    size = 2 * finished_run.WIDTH, 2 * finished_run.HEIGHT  # enough for the pages' --downscale 4
    write_nerfies(tmp_path / "SCENE", finished_run.FRAMES, *size, num_points=40)
    for name in ("RUN", "runs/demo"):
        shutil.copytree(run, name)
    monkeypatch.setattr(demo, "FOLDER", tmp_path / "SCENE")
    monkeypatch.setattr(engine, "train_steps", counting_step)
    monkeypatch.setattr(train, "contact_sheet", lambda run: np.zeros((8, 8, 3), np.uint8))
    monkeypatch.setattr(train, "write_run_video", lambda run, stem, quiet: stem)
    monkeypatch.setattr(view, "until_stopped", lambda: None)
    for _, _, module, *arguments in programs(page):
        training = module.endswith("train") and "--resume" not in arguments
        # Pages show several commands that fill the same folder.
        for folder in {"OUT", "RUN"} & set(arguments) if training else {"OUT"}:
            shutil.rmtree(folder, ignore_errors=True)
        importlib.import_module(module).main([*arguments, *(SHORT if training else [])])


def test_the_study_in_the_documentation_can_be_read(tmp_path):
    (study,) = blocks(ROOT / "docs" / "studies.md", "toml")
    (tmp_path / "study.toml").write_text(study)
    write_nerfies(tmp_path / "my" / "scene")
    assert len(read(tmp_path / "study.toml").plans) == 16
