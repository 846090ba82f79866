"""The members of a study, as its `results.json` lists them: what they are called, and which of them count."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

from l2dgs_jax.study.report import FINISHED

Member = dict[str, Any]


def labels(members: Sequence[Member]) -> dict[str, str]:
    """What tells a member from others of its scene and seed, by its name: the variant, and what a grid varies in it."""
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
    """Members whose scores are those of a scene half trained, which belong in no mean, and how they ended."""
    return [f"{member['name']} ({member['ended']})" for member in members if member["ended"] != FINISHED]
