"""Markdown for the tables of all experiments."""

from collections.abc import Mapping, Sequence

import numpy as np


def table_rows(lines: Sequence[Sequence[str]]) -> str:
    """The rows of a table, its heading and its rule included."""
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def mean_and_spread(scores: float | Sequence[float], digits: int) -> str:
    """The mean and, of several finite scores, half of their range."""
    spread = f" ± {np.ptp(scores) / 2:.{digits}f}" if np.size(scores) > 1 and np.isfinite(scores).all() else ""
    return f"{np.mean(scores):.{digits}f}{spread}"


def percentages(found: Mapping[str, Mapping[str, float | None]]) -> str:
    """A table of shares, a row for each scene; None has not been measured."""
    columns = list(next(iter(found.values())))
    lines = [["", *columns], ["---"] * (len(columns) + 1)]
    for scene, shares in found.items():
        lines.append([scene, *("" if (share := shares[name]) is None else f"{share:.1%}" for name in columns)])
    return table_rows(lines)
