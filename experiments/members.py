"""The members of a study, as listed in its `results.json`: their labels, and which of them count."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

from l2dgs_jax.study.report import FINISHED

Member = dict[str, Any]


def labels(members: Sequence[Member]) -> dict[str, str]:
    """Labels by members' names: the variant, and the settings that a grid varies in it, but not scene and seed."""
    values: dict[tuple[str, str], set[str]] = defaultdict(set)
    for member in members:
        for setting, value in member["varied"].items():
            values[member["variant"], setting].add(str(value))
    found = {}
    for member in members:
        variant, varied = member["variant"], member["varied"].items()
        parts = [f"{key} {value}" for key, value in varied if key != "seed" and len(values[variant, key]) > 1]
        found[member["name"]] = ", ".join([variant, *parts] if variant else parts) or "the preset"
    return found


def left_out(members: Iterable[Member]) -> list[str]:
    """Members that did not finish, whose scores belong in no mean, and how they ended."""
    return [f"{member['name']} ({member['ended']})" for member in members if member["ended"] != FINISHED]
