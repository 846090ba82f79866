"""Imports go one way: every layer uses only what comes before it."""

import ast
from pathlib import Path

import pytest

import l2dgs_jax

PACKAGE = Path(l2dgs_jax.__file__).parent
VOCABULARY = ("errors", "types")
FOLDERS = (
    "runtime",
    "config",
    "cameras",
    "data",
    "kernels",
    "rasterizer",
    "model",
    "metrics",
    "training",
    "runs",
    "visualize",
    "exporters",
    "viewer",
    "preprocess",
    "study",
)
COMMANDS = ("train", "evaluate", "render", "view", "export", "sweep", "prepare", "convert", "masks", "simulate")
LAYERS = (*VOCABULARY, *FOLDERS, "commands")
TOUCH_FILES = ("runtime", "data", "runs", "visualize", "preprocess", "study", "commands")
MODULES = [path for path in PACKAGE.rglob("*.py") if path not in (PACKAGE / "__init__.py", PACKAGE / "__main__.py")]
each_module = pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))


def layer(path):
    name = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    return "commands" if name in COMMANDS else name


def imported_modules(path):
    """Dotted names within the package that a file imports, with names that are not modules."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        yield from (name.removeprefix("l2dgs_jax.") for name in names if name.startswith("l2dgs_jax."))


def test_every_file_and_folder_has_its_layer():
    files = {path.stem for path in PACKAGE.glob("*.py")}
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__"}
    assert files == {*VOCABULARY, *COMMANDS, "__init__", "__main__"}
    assert folders == set(FOLDERS)


@each_module
def test_imports_go_one_way(path):
    own = LAYERS.index(layer(path))
    used = {name.split(".")[0] for name in imported_modules(path)}
    assert not used & set(COMMANDS), "commands are not imported"
    below = {name for name in used if LAYERS.index(name) > own}
    assert not below, f"{layer(path)} imports {below}, which come after it"


def module_of(name):
    """The file in which an imported name is defined."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        base = PACKAGE.joinpath(*parts[:end])
        if base.with_suffix(".py").exists():
            return base.with_suffix(".py")
        if end == len(parts) - 1 and (base / "__init__.py").exists():
            return base / "__init__.py"
    return None


def test_there_are_no_circular_imports():
    waiting = {path: {module_of(name) for name in imported_modules(path)} & set(MODULES) - {path} for path in MODULES}
    while waiting:
        ready = [path for path, used in waiting.items() if not used & waiting.keys()]
        assert ready, f"a circle among {sorted(str(path.relative_to(PACKAGE)) for path in waiting)}"
        for path in ready:
            del waiting[path]


@each_module
def test_jaxopt_and_files_stay_where_they_belong(path):
    source = path.read_text()
    if path != PACKAGE / "training" / "optimizer.py":
        assert "import jaxopt" not in source
        assert "from jaxopt" not in source
    if layer(path) not in TOUCH_FILES:
        assert "open(" not in source
        assert "pathlib" not in source


@each_module
def test_the_compilers_attributes_stay_in_one_folder(path):
    if layer(path) != "kernels":
        assert f"xla_{'cpu'}" not in path.read_text()


@each_module
def test_no_file_exceeds_400_lines(path):
    assert len(path.read_text().splitlines()) <= 400
