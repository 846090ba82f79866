"""Settings by dotted names such as "loss.exposure_level": read, check, replace, or pass them to a compiled program."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from l2dgs_jax.config.settings import TRACEABLE, Config


def _fields(kind: type, prefix: str = "") -> dict[str, Any]:
    """The declared type of every setting by its dotted name."""
    fields: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        nested = isinstance(field.type, type) and dataclasses.is_dataclass(field.type)
        fields |= _fields(field.type, f"{prefix}{field.name}.") if nested else {f"{prefix}{field.name}": field.type}  # type: ignore[arg-type]
    return fields


_FIELDS = _fields(Config)
_KINDS = {name: TRACEABLE.get(kind, kind) for name, kind in _FIELDS.items()}

# Numbers that a training step only calculates with: scenes that differ in nothing else can share a compiled program.
# (Learning rates, their decay and initial values are not even read by a step.)
TRACED = frozenset(name for name, kind in _FIELDS.items() if kind in TRACEABLE)


@dataclass(frozen=True)
class StaticConfig:
    """The settings that a program is compiled for: a `Config` with holes that `combine` fills.

    Attributes:
        outline: the settings, with 0 in the holes.
        holes: dotted names of the settings that the program takes as arguments.
    """

    outline: Config
    holes: tuple[str, ...] = ()


def partition(configs: Sequence[Config]) -> tuple[StaticConfig, dict[str, list[Any]]]:
    """Split configs into what they have in common and the numbers in which they differ, by name: a value per config.

    Raises:
        ValueError: they differ in a setting that a program cannot take as an argument.
    """
    columns = differences(configs)
    static = sorted(columns.keys() - TRACED)
    if static:
        raise ValueError(f"{static[0]} is {columns[static[0]]}; expected settings that differ in numbers only")
    blanks = {name: _blank(read(configs[0], name)) for name in columns}
    return StaticConfig(replace(configs[0], blanks), tuple(sorted(columns))), columns


def combine(static: StaticConfig, values: Mapping[str, Any]) -> Config:
    """The settings with their holes filled; `values` may be traced.

    Raises:
        ValueError: `values` does not have exactly the names of the holes.
    """
    if values.keys() != set(static.holes):
        raise ValueError(f"values for {sorted(values)}; expected them for {list(static.holes)}")
    return replace(static.outline, values)


def replace(config: Config, values: Mapping[str, Any]) -> Config:
    """The settings with some replaced by values of the same kind."""
    own = {name: value for name, value in values.items() if "." not in name}
    nested: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        parent, _, field = name.rpartition(".")
        if parent:
            nested.setdefault(parent, {})[field] = value
    parts = {parent: dataclasses.replace(getattr(config, parent), **fields) for parent, fields in nested.items()}
    return dataclasses.replace(config, **own, **parts)


def checked(name: str, value: Any) -> Any:
    """The value converted to the setting's type: integers to floats, lists to tuples, "None" to None where they fit.

    Raises:
        ValueError: there is no such setting, or it takes no such value.
    """
    if name not in _KINDS:
        raise ValueError(f"{name} is not a setting; expected one that `python -m l2dgs_jax.train --help` lists")
    for candidate in (value, None) if value == "None" else (value,):
        fits, converted = _fit(candidate, _KINDS[name])
        if fits:
            return converted
    kind = _KINDS[name]
    raise ValueError(f"{name} is {value!r}; expected {kind.__name__ if isinstance(kind, type) else kind}")


def from_dict(values: dict[str, Any]) -> Config:
    """The inverse of `settings.to_dict`; settings that are missing have their defaults.

    Raises:
        ValueError: a setting is unknown, or takes no such value.
    """
    named: dict[str, Any] = {}
    for name, value in values.items():
        named |= {f"{name}.{field}": v for field, v in value.items()} if isinstance(value, dict) else {name: value}
    return replace(Config(), {name: checked(name, value) for name, value in named.items()})


def outline(config: Config) -> Config:
    """The settings with those of `TRACED` set to 0: equal for scenes that can share a compiled program."""
    return replace(config, {name: _blank(read(config, name)) for name in TRACED})


def differences(configs: Sequence[Config]) -> dict[str, list[Any]]:
    """The settings in which some of the configs differ, each with its value in every config."""
    values = {name: [read(config, name) for config in configs] for name in _KINDS}
    return {name: column for name, column in values.items() if any(value != column[0] for value in column)}


def read(config: Config, name: str) -> Any:
    """The value of a setting, by its dotted name."""
    value: Any = config
    for part in name.split("."):
        value = getattr(value, part)
    return value


def _blank(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_blank(item) for item in value)
    return type(value)(0) if _is_number(value) else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _fit(value: Any, kind: Any) -> tuple[bool, Any]:
    """Whether a value is of a declared kind, and the value converted to it."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return next((found for found in (_fit(value, option) for option in arguments) if found[0]), (False, None))
    if origin is Literal:
        return value in arguments, value
    if origin is tuple:
        if not isinstance(value, list | tuple):
            return False, None
        kinds = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        items = [_fit(item, item_kind) for item, item_kind in zip(value, kinds, strict=False)]
        return len(value) == len(kinds) and all(fits for fits, _ in items), tuple(item for _, item in items)
    if kind is float:
        return (True, float(value)) if _is_number(value) and abs(value) < 1e300 else (False, None)
    if kind is int:
        return _is_number(value) and isinstance(value, int) and abs(value) < 2**31, value
    return isinstance(value, NoneType if kind is None else kind), value
