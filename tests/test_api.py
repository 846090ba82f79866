"""The public API: it exports all that its signatures mention, and the README's programs run."""

import inspect
import re
import types
import typing
from importlib.metadata import version
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import skimage

import l2dgs_jax
from l2dgs_jax import runs
from l2dgs_jax.config import overrides
from l2dgs_jax.runs import checkpoints
from l2dgs_jax.training import initial_state, resolve

README = Path(__file__).parents[1] / "README.md"


def classes_in(annotation):
    """The classes of the package that an annotation mentions."""
    if isinstance(annotation, type) and annotation.__module__.startswith("l2dgs_jax."):
        yield annotation
    for part in typing.get_args(annotation):
        yield from classes_in(part) if not isinstance(part, list) else [c for p in part for c in classes_in(p)]


def public_functions():
    for name in l2dgs_jax.__all__:
        thing = getattr(l2dgs_jax, name)
        if isinstance(thing, types.FunctionType):
            yield thing
        elif isinstance(thing, type):
            yield from (f for key, f in vars(thing).items() if inspect.isfunction(f) and not key.startswith("_"))


def test_everything_that_is_exported_exists():
    assert len(set(l2dgs_jax.__all__)) == len(l2dgs_jax.__all__)
    assert all(hasattr(l2dgs_jax, name) for name in l2dgs_jax.__all__)
    assert l2dgs_jax.__version__ == version("l2dgs-jax")
    assert (Path(l2dgs_jax.__file__).parent / "py.typed").exists()


@pytest.mark.parametrize("function", list(public_functions()), ids=lambda f: f.__qualname__)
def test_classes_in_public_signatures_are_exported(function):
    mentioned = {c.__name__ for a in function.__annotations__.values() for c in classes_in(a)}
    assert mentioned <= set(l2dgs_jax.__all__)


@pytest.mark.slow
def test_the_readmes_programs_run_as_printed(tmp_path, monkeypatch):
    opened, trained = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.S)
    monkeypatch.chdir(tmp_path)
    small = {"coarse_steps": 1, "fine_steps": 1, "model.hidden": 8, "model.plane_size": 4}
    config = overrides.replace(l2dgs_jax.PRESETS["demo"], small)
    dataset = l2dgs_jax.load_dataset("demo")
    resolved = resolve(config, dataset)
    runs.write_settings(Path("runs/demo"), "demo", resolved)
    state = initial_state(dataset, resolved)._replace(step=jnp.int32(2))
    checkpoints.save(Path("runs/demo") / runs.CHECKPOINT, l2dgs_jax.Checkpoint(state, 1024), resolved)

    names = {}
    exec(opened, names)
    assert names["view"].images.welllit.shape == (192, 256, 3)
    assert names["large"].images.welllit.shape == (384, 512, 3)
    assert skimage.io.imread("large.png").shape == (384, 512, 3)
    smaller = names["large"].alpha.reshape(192, 2, 256, 2).mean((1, 3))
    assert np.abs(smaller - names["view"].alpha).mean() < 0.05

    steps = []
    monkeypatch.setitem(l2dgs_jax.PRESETS, "demo", config)
    exec(trained, names | {"print": steps.append})
    assert steps == [1, 2]
    reopened = l2dgs_jax.open_run("runs/fitted")
    assert reopened.state.step == 2
    assert reopened.config.coarse_steps == 1
