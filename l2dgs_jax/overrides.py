"""Settings by their dotted names, such as "loss.exposure_level": read, checked, replaced, and told apart."""

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from l2dgs_jax.config import Config, DensityConfig, LossConfig, OptimConfig

# Numbers that a training step only calculates with: scenes that differ in nothing else can share a compiled program.
# (Those of `optim.schedules` and of the initial state are not even read by a step.)
TRACED = frozenset(
    {f"{part}.{f.name}" for part, kind in (("loss", LossConfig), ("optim", OptimConfig), ("density", DensityConfig))
     for f in dataclasses.fields(kind) if f.type is float}
) | {
    "seed", "optim.decay_steps", "density.prune_above", "density.max_gaussians", "model.illumination_offset",
    "model.initial_exponents", "model.initial_illumination", "model.initial_opacity",
}  # fmt: skip


def replace(config: Config, values: Mapping[str, Any]) -> Config:
    """The settings with some replaced, unchecked: the values may be traced."""
    replaced = copy.copy(config)
    for name, value in values.items():
        *parents, field = name.split(".")
        owner: Any = replaced
        for parent in parents:
            inner = copy.copy(getattr(owner, parent))
            object.__setattr__(owner, parent, inner)  # of our own copy, which is frozen for everyone else
            owner = inner
        object.__setattr__(owner, field, value)
    return replaced


def checked(name: str, value: Any) -> Any:
    """The value as that setting holds it: whole numbers as floats, lists as tuples, "None" as None where they fit.

    Raises:
        ValueError: there is no such setting, or it takes no such value.
    """
    if name not in _KINDS:
        raise ValueError(f"{name} is no setting; expected one of those that `python -m l2dgs_jax.train --help` lists")
    for candidate in (value, None) if value == "None" else (value,):
        fits, converted = _fit(candidate, _KINDS[name])
        if fits:
            return converted
    kind = _KINDS[name]
    raise ValueError(f"{name} is {value!r}; expected {kind.__name__ if isinstance(kind, type) else kind}")


def outline(config: Config) -> Config:
    """The settings with every number of `TRACED` blanked: equal for scenes that can share a compiled program."""
    return replace(config, {name: _blank(_read(config, name)) for name in TRACED})


def differences(configs: Sequence[Config]) -> dict[str, list[Any]]:
    """The settings in which some of the configs differ, each with its value in every one of them."""
    values = {name: [_read(config, name) for config in configs] for name in _KINDS}
    return {name: column for name, column in values.items() if any(value != column[0] for value in column)}


def _kinds(kind: type, prefix: str = "") -> dict[str, Any]:
    kinds: dict[str, Any] = {}
    for field in dataclasses.fields(kind):
        nested = isinstance(field.type, type) and dataclasses.is_dataclass(field.type)
        kinds |= _kinds(field.type, f"{prefix}{field.name}.") if nested else {f"{prefix}{field.name}": field.type}  # type: ignore[arg-type]
    return kinds


_KINDS = _kinds(Config)


def _read(config: Config, name: str) -> Any:
    value: Any = config
    for part in name.split("."):
        value = getattr(value, part)
    return value


def _blank(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_blank(item) for item in value)
    return 0 if _is_number(value) else value


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
