"""Statistics of the user study: percentages of choices and mean ratings from the participants' files.

People are the sample, not their answers: those of one person resemble each other. An estimate is the ratio of two sums
over people, because they may give different numbers of answers, and the deviations from it, one per person, give the
variance of the ratio by linearisation.
"""

import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from l2dgs_jax.errors import UserError

CRITERIA = (
    "Natural-looking brightness and lighting",
    "Foreground reconstruction",
    "Preservation of scene structure",
    "Faithful and natural color",
    "Minimal reconstruction artifacts",
)
RATINGS = (1, 5)
CONFIDENCE = 0.95
METHOD = (
    f"{100 * CONFIDENCE:.0f} % confidence intervals over people, by Student's t for a ratio of sums, or "
    "Clopper-Pearson's where all agree on 0 or 100 %; none for fewer than two people, or where all gave the same mean "
    "otherwise"
)

Estimate = dict[str, float | None]


def aggregate(key: dict[str, Any], answers: dict[Path, dict[str, Any]]) -> dict[str, Any]:
    """Percentages of choices and mean ratings by method and criterion, each with its confidence interval.

    Args:
        key: as `make_page` writes it.
        answers: what each file holds. Unanswered questions do not count.

    Raises:
        UserError: there are no answers, a file is for another page or holds answers that the page does not offer, or a
            name is in files from different browsers.
    """
    people = _participants([_read_person(key, path, content) for path, content in answers.items()])
    if not people:
        raise UserError("no file with answers was named; expected those that the page left")
    chosen, choices, rated, ratings = (np.stack(part) for part in zip(*(p.counts for p in people), strict=True))
    table = lambda cell: {method: [cell(m, c) for c in range(len(CRITERIA))] for m, method in enumerate(key["methods"])}
    return {
        "participants": len(people),
        "interval": METHOD,
        "chosen": table(lambda m, c: percentage(chosen[:, m, c], choices[:, c])),
        "rating": table(lambda m, c: ratio(rated[:, m, c], ratings[:, m, c], RATINGS)),
    }


class _Person(NamedTuple):
    """What a file says: who saved it when in which browser, and the counts of `_count`."""

    path: Path
    browser: str
    name: str
    saved: float
    counts: tuple[np.ndarray, ...]


def _participants(people: Sequence[_Person]) -> list[_Person]:
    """Those who gave answers, each once; says on standard error which files are left out."""
    found: dict[str, _Person] = {}
    last = {person.browser: person for person in sorted(people, key=lambda person: person.saved)}
    for person in people:
        name = person.name.strip().casefold()
        if (later := last[person.browser]) is not person:
            print(f"{person.path}: left out, because {later.path} was saved later in that browser", file=sys.stderr)
        elif not any(part.any() for part in person.counts):
            print(f"{person.path}: left out, because it holds no answers", file=sys.stderr)
        elif (other := found.setdefault(name, person)) is not person:
            raise UserError(
                f"{person.path}: is by {person.name!r} like {other.path}, but from another browser; expected another "
                '"participant" in one of them if they are two people, or else only one of the files'
            )
    return list(found.values())


def _read_person(key: dict[str, Any], path: Path, content: dict[str, Any]) -> _Person:
    if content.get("study") != key["study"]:
        raise UserError(f"{path}: answers to {content.get('study')!r}; expected answers to {key['study']!r}")
    try:
        browser, name, saved = content["id"], content["participant"], datetime.fromisoformat(content["saved"])
        assert isinstance(browser, str)
        assert isinstance(name, str)
        return _Person(path, browser, name, saved.timestamp(), _count(key, content["answers"]))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, AssertionError, OverflowError):
        raise UserError(f"{path}: holds answers that the page does not offer; expected a file that it left") from None


def _count(key: dict[str, Any], answers: Sequence[dict[str, Any]]) -> tuple[np.ndarray, ...]:
    """One participant's choices [M 5] and their number [5], and sums of ratings [M 5] and their number [M 5]."""
    methods = key["methods"]
    chosen, choices = np.zeros((len(methods), len(CRITERIA))), np.zeros(len(CRITERIA))
    rated, ratings = np.zeros_like(chosen), np.zeros_like(chosen)
    seen = set()
    for answer in answers:
        criterion, scene, given = answer["criterion"], answer["scene"], answer.get("ratings", {})
        unasked = (key["kind"] == "binary" and given) or (key["kind"] == "rating" and "best" in answer)
        if unasked or criterion not in range(len(CRITERIA)) or (scene, criterion) in seen:
            raise ValueError
        seen.add((scene, criterion))
        letters = key["scenes"][scene]["letters"]
        if "best" in answer:
            chosen[methods.index(letters[answer["best"]]), criterion] += 1
            choices[criterion] += 1
        for letter, rating in given.items():
            if rating not in range(RATINGS[0], RATINGS[1] + 1):
                raise ValueError
            rated[methods.index(letters[letter]), criterion] += rating
            ratings[methods.index(letters[letter]), criterion] += 1
    return chosen, choices, rated, ratings


def ratio(
    sums: Float[np.ndarray, " P"], counts: Float[np.ndarray, " P"], limits: tuple[float, float]
) -> Estimate | None:
    """Sum over sum as `value`, with the bounds `low` and `high` of its interval, None where there is no interval.

    Args:
        sums: whole numbers, of each person.
        counts: of the answers added up in each sum; 0 for who gave none.
        limits: least and greatest possible value, to which the interval is clipped.

    Returns:
        None if nobody answered.
    """
    people, total = np.count_nonzero(counts), counts.sum()
    if not people:
        return None
    value = sums.sum() / total
    deviations = sums * total - counts * sums.sum()  # times the total, so that they are exactly 0 where all agree
    if not deviations.any():  # also of a single person
        return {"value": float(value), "low": None, "high": None}
    error = np.sqrt(people / (people - 1) * np.square(deviations).sum()) / total**2
    reach = error * stats.t.ppf((1 + CONFIDENCE) / 2, people - 1)
    low, high = np.clip((value - reach, value + reach), *limits)
    return {"value": float(value), "low": float(low), "high": float(high)}


def percentage(chosen: Float[np.ndarray, " P"], choices: Float[np.ndarray, " P"]) -> Estimate | None:
    """Like `ratio`, in percent; people who all agree on 0 or 100 % are trials with one outcome."""
    found, people = ratio(100 * chosen, choices, (0, 100)), np.count_nonzero(choices)
    if found and people >= 2 and found["value"] in (0, 100):
        interval = stats.binomtest(people if found["value"] else 0, people).proportion_ci(CONFIDENCE, "exact")
        found |= {"low": 100 * interval.low, "high": 100 * interval.high}
    return found
