"""The README and the pages of the documentation: what they tell to type is run as printed.

Trainings are shortened in one way, by the options of `SHORT`. SCENE, RUN and runs/demo are a tiny scene and a tiny run,
and so is the demo.
"""

import importlib
import re
import shlex
import shutil
from pathlib import Path

import finished_run
import pytest
from scenes import write_nerfies

from l2dgs_jax.__main__ import COMMANDS
from l2dgs_jax.data import demo
from l2dgs_jax.study.spec import read

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SHORT = ["--coarse-steps=0", "--fine-steps=2", "--model.plane-size=4", "--model.plane-scales=1", "--model.hidden=8"]
# Not run: what installs; what finds poses, trains studies or chooses kernels, as their own tests do; and what wants
# several hosts, weights that are not here, or hours.
INSTALLS = ("git ", "cd ", "pip ", "pytest", "pre-commit")
LEFT_OUT = ("prepare", "sweep", "L2DGS_JAX_KERNELS", "XLA_FLAGS", "--weights", "experiments")


def blocks(page, language):
    found = re.findall(rf"^( *)```{language}\n(.*?)^\1```", page.read_text(), re.S | re.M)
    return [re.sub(rf"^{indent}", "", block, flags=re.M) for indent, block in found]


def programs(page):
    """The commands that a page tells to type, as words."""
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


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if any(programs(page))], ids=lambda page: page.stem)
def test_what_a_page_tells_to_type_runs(page, tmp_path_factory, tmp_path, monkeypatch):
    run = finished_run.folder(tmp_path_factory.getbasetemp() / "docs")
    scene = write_nerfies(tmp_path / "SCENE", 10, 48, 36, num_points=40, truth=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(demo, "FOLDER", scene)
    for name in ("RUN", "runs/demo"):
        shutil.copytree(run, name)
    for _, _, module, *arguments in programs(page):
        training = module.endswith("train") and "--resume" not in arguments
        for place in ("OUT", "RUN") if training else ("OUT",):  # pages show several commands that fill the same one
            shutil.rmtree(place, ignore_errors=True)
        importlib.import_module(module).main([*arguments, *(SHORT if training else [])])


def test_the_study_of_the_documentation_is_one(tmp_path):
    (study,) = blocks(ROOT / "docs" / "studies.md", "toml")
    (tmp_path / "study.toml").write_text(study)
    write_nerfies(tmp_path / "my" / "scene")
    assert len(read(tmp_path / "study.toml").plans) == 16
