"""Data moves one way: each module imports only from modules above it in this list."""

import ast
from pathlib import Path

import pytest

import l2dgs_jax

ORDER = [
    "errors",
    "files",
    "threads",
    "types",
    "native",
    "config",
    "tone",
    "data",
    "epipolar",
    "motion",
    "hexplane",
    "convolution",
    "networks",
    "spherical_harmonics",
    "deformation",
    "scene",
    "projection",
    "rasterizer",
    "decomposition",
    "rendering",
    "metrics",
    "losses",
    "optim",
    "zerodce",
    "lowlight",
    "density",
    "overrides",
    "devices",
    "step",
    "engine",
    "checkpoint",
    "torch_pickle",
    "darkeners",
    "runs",
    "recording",
    "cli",
    "hosts",
    "visualize",
    "capture",
    "render",
    "evaluate",
    "train",
    "study",
    "sweep",
    "convert",
    "masks",
    "simulate",
    "prepare",
]
PACKAGE = Path(l2dgs_jax.__file__).parent
MODULES = [path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py"]


def layer(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_layers(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module == "l2dgs_jax":
            names = [f"l2dgs_jax.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        else:
            continue
        yield from (name.split(".")[1] for name in names if name.startswith("l2dgs_jax."))


def test_the_order_lists_every_module_once():
    assert sorted(ORDER) == sorted({layer(path) for path in MODULES})


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    own = ORDER.index(layer(path))
    later = {name for name in imported_layers(path) if ORDER.index(name) > own}
    assert not later, f"{layer(path)} imports {later}, which come after it"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_jaxopt_and_files_stay_where_they_belong(path):
    source = path.read_text()
    if layer(path) not in ("optim", "step"):
        assert "import jaxopt" not in source
        assert "from jaxopt" not in source
    if ORDER.index(layer(path)) <= ORDER.index("engine") and layer(path) not in ("files", "data"):
        assert "open(" not in source
        assert "Path" not in source


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_file_is_read_in_one_sitting(path):
    assert len(path.read_text().splitlines()) <= 400
