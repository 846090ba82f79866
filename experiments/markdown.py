"""Markdown for the tables of all experiments."""

from collections.abc import Sequence

import numpy as np


def table_rows(lines: Sequence[Sequence[str]]) -> str:
    """The rows of a table, its heading and its rule included."""
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def mean_and_spread(scores: float | Sequence[float], digits: int) -> str:
    """The mean and, of several scores, half of their range."""
    spread = f" ± {np.ptp(scores) / 2:.{digits}f}" if np.size(scores) > 1 else ""
    return f"{np.mean(scores):.{digits}f}{spread}"
