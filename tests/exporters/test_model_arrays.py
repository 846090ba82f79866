"""The whole model as arrays: all are documented, and the program in the documentation renders them."""

import dataclasses
import re
from pathlib import Path

import finished_run
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from l2dgs_jax.errors import UserError
from l2dgs_jax.exporters.model_arrays import model_arrays

PAGE = (Path(__file__).parents[2] / "docs" / "export.md").read_text()


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return finished_run.opened(tmp_path_factory.getbasetemp())


def documented():
    """Patterns of the names in the documentation's table."""
    rows = [line for line in PAGE.partition("## The whole model")[2].splitlines() if line.startswith("| `")]
    names = [name for row in rows for name in re.findall("`([^`]+)`", row.split("|")[1])]
    return [re.escape(name).replace(r"\.\.\.", "[^/]+").replace("K", r"\d") for name in names]


def test_every_array_is_documented_and_plain(run, tmp_path):
    np.savez(tmp_path / "scene.npz", **model_arrays(run))
    patterns = documented()
    with np.load(tmp_path / "scene.npz", allow_pickle=False) as model:
        assert [name for name in model if not any(re.fullmatch(pattern, name) for pattern in patterns)] == []
        unused = [pattern for pattern in patterns if not any(re.fullmatch(pattern, name) for name in model)]
        optional = ("gate", "opacity", "paths", "lifetimes", "bafe/conv", "bafe/norm", "bafe/out/weight")
        assert all(any(name in pattern for name in optional) for pattern in unused)
        assert all(model[name].dtype.kind in "biU" or model[name].dtype == np.float32 for name in model)


def test_dead_gaussians_are_not_exported(run):
    scene = run.state.scene
    some_dead = scene._replace(alive=scene.alive.at[jnp.array([0, 5])].set(False))
    fewer = dataclasses.replace(run, state=run.state._replace(scene=some_dead))
    before, after = (model_arrays(scene_run)["gaussians/means"] for scene_run in (run, fewer))
    np.testing.assert_array_equal(np.delete(before, [0, 5], axis=0), after)


@pytest.mark.parametrize("part", [{"decomposition": "none"}, {"ocd": False}, {"unit_exponent": "b1"}])
def test_models_that_the_documented_program_cannot_render_are_refused(run, part):
    config = dataclasses.replace(run.config, model=dataclasses.replace(run.config.model, **part))
    with pytest.raises(UserError, match=f"model.{next(iter(part))} is"):
        model_arrays(dataclasses.replace(run, config=config))


@pytest.mark.slow
@pytest.mark.parametrize(
    "variant",
    [
        {},
        {"aggregation": "product", "box_rim": 0.2, "domain": "values", "relative_light": False, "bafe": True},
        {"background": 0.7, "shut_gates": 0.5, "domain": "light", "relative_light": True},
    ],
)
def test_the_documented_program_renders_the_model(run, variant, tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    shake = lambda x: x + jnp.asarray(rng.normal(0, 0.3, x.shape), x.dtype)
    params = jax.tree.map(shake, run.state.scene.params)
    count = len(run.state.scene.alive)
    lifetimes = np.where(np.arange(count)[:, None] % 3 > 0, [-np.inf, np.inf], [0.1, 0.9])
    gaussians = run.state.scene.params.gaussians._replace(
        gate=jnp.asarray(rng.normal(0, 1, count)),
        lifetimes=jnp.asarray(lifetimes),
    )
    params = params._replace(gaussians=gaussians, paths=jnp.asarray(rng.normal(0, 0.05, (7, 5, 3))))
    path_of = jnp.asarray(rng.integers(7, size=count))
    state = run.state._replace(scene=run.state.scene._replace(params=params, path_of=path_of))
    model = dataclasses.replace(run.config.model, **variant)
    run = dataclasses.replace(run, state=state, config=dataclasses.replace(run.config, model=model))
    monkeypatch.chdir(tmp_path)
    np.savez("scene.npz", **model_arrays(run))
    (program,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.S)
    names = {}
    exec(program, names)
    images = run.render(run.dataset.train.camera(0)).images
    assert images.welllit.std() > 0.02
    for name in ("welllit", "lowlight"):
        np.testing.assert_allclose(names[name], getattr(images, name), atol=2e-3)
