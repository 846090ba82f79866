"""The TOML file that describes a study, and the members that it defines."""

import itertools
import os
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from l2dgs_jax.config import PRESETS, Config, overrides
from l2dgs_jax.errors import UserError

KEYS = ("scenes", "seeds", "preset", "settings", "grid", "variants", "one_program")


@dataclass(frozen=True)
class Plan:
    """A member of a study before anything is loaded.

    Attributes:
        name: unique, and usable as the name of a folder.
        variant: name of its variant; empty if there are none.
        scene: folder of its scene, or "demo".
        config: its settings.
        varied: this member's values of the settings that the study varies, by dotted name, and its "preset" if the
            variant has one of its own.
    """

    name: str
    variant: str
    scene: str
    config: Config
    varied: dict[str, Any]


@dataclass(frozen=True)
class Spec:
    """A study: its members, and whether one compiled program must train them all."""

    plans: tuple[Plan, ...]
    one_program: bool


def read(path: Path, scenes: Sequence[str] = ()) -> Spec:
    """Read a study from a TOML file.

    Its keys: `scenes` (folders relative to that of the file, or "demo"), `seeds` ([0] if not given), `preset`
    ("default" if not given), `[settings]` for all members, `[grid]` with a list of values for each setting, all
    combinations of which are trained, `[[variants]]`, each with a `name`, settings and optionally a `preset` of its
    own, and `one_program`. The members are all scenes x seeds x combinations x variants.

    Args:
        path: the file.
        scenes: replace those in the file: absolute paths, or "demo".

    Raises:
        UserError: the file cannot be read, or has an unknown key or an invalid value.
    """
    content = _read_toml(path)
    unknown = sorted(content.keys() - set(KEYS))
    if unknown:
        raise UserError(f"{path}: the key '{unknown[0]}' is unknown; expected {', '.join(KEYS)}")
    scenes = scenes or [_scene(path, scene) for scene in _list(path, content, "scenes", str)]
    seeds = _list(path, content, "seeds", int) if "seeds" in content else [0]
    preset = _preset(path, content.get("preset", "default"))
    one_program = content.get("one_program", False)
    if not isinstance(one_program, bool):
        raise UserError(f"{path}: one_program is {one_program!r}; expected true or false")
    settings = _settings(path, "settings", content.get("settings", {}))
    grid = _grid(path, content.get("grid", {}))
    variants = _variants(path, content.get("variants", [{}]))
    _check_different(path, scenes)
    _check_disjoint(path, grid, variants)

    plans: list[Plan] = []
    for scene, seed, point, (label, own_preset, variant) in itertools.product(scenes, seeds, grid, variants):
        varied = {"seed": seed, **point, **variant}
        try:
            config = overrides.replace(PRESETS[own_preset or preset], settings | varied)
            config.check()
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
        parts = [f"{len(plans):02d}", Path(scene).name, f"seed{seed}", *_labels(point), *([label] if label else [])]
        shown = {"seed": seed} | ({"preset": own_preset} if own_preset else {}) | varied
        plans.append(Plan("-".join(parts), label, scene, config, shown))
    return Spec(tuple(plans), one_program)


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text())
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); expected a TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: is not TOML ({error}); expected a file like the one in docs/studies.md") from None


def _list(path: Path, content: dict[str, Any], key: str, kind: type) -> list:
    """The values of a list, which must have at least one, all distinct and of one type."""
    values: Any = content.get(key)
    name = {str: "names", int: "whole numbers from 0 below 2^31"}[kind]

    def fits(value: Any) -> bool:
        return isinstance(value, kind) and not isinstance(value, bool) and (kind is str or value in range(2**31))

    if not isinstance(values, list) or not values or not all(map(fits, values)) or len(set(values)) < len(values):
        raise UserError(f"{path}: {key} is {values!r}; expected a list of different {name}, at least one")
    return values


def _scene(path: Path, scene: str) -> str:
    return scene if scene == "demo" else str((path.parent / os.path.expanduser(scene)).absolute())


def _check_different(path: Path, scenes: Sequence[str]) -> None:
    folders = [scene if scene == "demo" else str(Path(scene).resolve()) for scene in scenes]
    for index, (scene, folder) in enumerate(zip(scenes, folders, strict=True)):
        if folder in folders[:index]:
            raise UserError(f"{path}: the scene {scene} is named twice; expected different folders")


def _check_disjoint(
    path: Path, grid: Sequence[dict[str, Any]], variants: Sequence[tuple[str, str | None, dict[str, Any]]]
) -> None:
    for label, _, variant in variants:
        for name in variant.keys() & grid[0].keys():
            raise UserError(f"{path}: the variant '{label}' sets {name}, which [grid] varies; expected one of the two")


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables flattened to dotted names."""
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def _settings(path: Path, key: str, table: Any) -> dict[str, Any]:
    if not isinstance(table, dict):
        raise UserError(f"{path}: {key} is {table!r}; expected a table of settings")
    return {name: _checked(path, key, name, value) for name, value in _flat(table).items()}


def _checked(path: Path, key: str, name: str, value: Any) -> Any:
    if name == "seed":
        raise UserError(f"{path}: [{key}] sets the seed; expected the key seeds")
    try:
        return overrides.checked(name, value)
    except ValueError as error:
        raise UserError(f"{path}: [{key}] {error}") from None


def _grid(path: Path, table: Any) -> list[dict[str, Any]]:
    """Every combination of the values in a table that lists values for each setting."""
    if not isinstance(table, dict):
        raise UserError(f"{path}: grid is {table!r}; expected a table with a list of values for each setting")
    columns = []
    for name, values in _flat(table).items():
        if not isinstance(values, list) or not values:
            raise UserError(f"{path}: [grid] {name} is {values!r}; expected a list of values, at least one")
        checked = [_checked(path, "grid", name, value) for value in values]
        if any(value in checked[:index] for index, value in enumerate(checked)):
            raise UserError(f"{path}: [grid] {name} is {values!r}; expected different values")
        columns.append([(name, value) for value in checked])
    return [dict(point) for point in itertools.product(*columns)]


def _preset(path: Path, name: Any) -> str:
    if not isinstance(name, str) or name not in PRESETS:
        raise UserError(f"{path}: no preset is called {name!r}; expected one of {', '.join(PRESETS)}")
    return name


def _variants(path: Path, tables: Any) -> list[tuple[str, str | None, dict[str, Any]]]:
    """Name, preset of its own (or None) and settings of each variant; a single nameless variant if there are none."""
    if tables == [{}]:
        return [("", None, {})]
    named = isinstance(tables, list) and all(isinstance(t, dict) and isinstance(t.get("name"), str) for t in tables)
    names = [table["name"] for table in tables] if named else []
    if not names or len(set(names)) < len(names) or not all(name.replace("_", "").isalnum() for name in names):
        raise UserError(f"{path}: every one of [[variants]] must have a name of its own, of letters, digits and _")
    found = []
    for name, table in zip(names, tables, strict=True):
        own = _preset(path, table["preset"]) if "preset" in table else None
        rest = {key: value for key, value in table.items() if key not in ("name", "preset")}
        found.append((name, own, _settings(path, f"variants.{name}", rest)))
    return found


def _labels(point: dict[str, Any]) -> list[str]:
    """A combination of settings as parts of a folder's name."""

    def text(value: Any) -> str:
        return "_".join(map(str, value)) if isinstance(value, tuple) else str(value)

    return [f"{name.split('.')[-1]}{text(value)}" for name, value in point.items()]
