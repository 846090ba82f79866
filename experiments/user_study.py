"""The user study of Table 2: a page on which methods are judged blindly, and the table of the answers.

    python -m experiments.user_study page MEDIA study.html --seed 1     # MEDIA/METHOD/SCENE.mp4 (or .webm, .png ...)
    python -m experiments.user_study table study.key.json answers/*.json

The page is self-contained and works offline; each participant downloads their answers from it as a file. Methods are
shown as letters, which are assigned at random for every scene; only the key file says which method is which. Do not
give that file to the participants.
"""

import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from experiments.markdown import table_rows
from experiments.published import TABLE2
from experiments.web_page import write_page
from l2dgs_jax.data.parsing import read_json, value
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import is_taken, replacing, write_json
from l2dgs_jax.runtime.pages import data_url

CRITERIA = (
    "Natural-looking brightness and lighting",
    "Foreground reconstruction",
    "Preservation of scene structure",
    "Faithful and natural color",
    "Minimal reconstruction artifacts",
)
RATINGS = (1, 5)
SUFFIXES = (".mp4", ".webm", ".png", ".jpg", ".jpeg", ".webp")
INPUT = "input"  # folder in MEDIA that is shown beside the methods but not judged
RESAMPLES, COVERAGE = 10_000, 0.95
NUMERALS = ("i", "ii", "iii", "iv", "v")


@dataclass(frozen=True)
class Page:
    """Make a page from the folders of several methods, each with one picture or video of every scene.

    Attributes:
        media: folder that contains the methods' folders; one called "input" is shown for comparison.
        output: the page, .html; its key file is written beside it.
        seed: of the random order of scenes and of the methods in each.
        kind: task of the participants, for each criterion: choose the best result ("binary"), rate every result from 1
            (poor) to 5 (best) ("rating"), or both.
    """

    media: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    seed: int = 0
    kind: Literal["binary", "rating", "both"] = "both"


@dataclass(frozen=True)
class Table:
    """Summarise answers in the form of the paper's Table 2: percent of choices / mean rating.

    In brackets are 95 % confidence intervals by bootstrap over participants, because answers of one person are not
    independent.

    Attributes:
        key: key file that `page` wrote.
        answers: files downloaded from the page, one per participant.
        json: file to write the numbers to.
    """

    key: tyro.conf.Positional[Path]
    answers: tyro.conf.Positional[tuple[Path, ...]]
    json: Path | None = None


def main(arguments: Sequence[str]) -> None:
    name = lambda kind, word: Annotated[kind, tyro.conf.subcommand(word)]
    options = tyro.cli(name(Page, "page") | name(Table, "table"), args=arguments, description=__doc__)
    if isinstance(options, Page):
        make_page(options)
        return
    key = read_json(options.key, "a key that `page` wrote")
    for entry, kind in {"study": str, "methods": list, "key": dict}.items():
        value(options.key, key, entry, kind)
    for scene, dealt in key["key"].items():
        if not isinstance(dealt, dict) or sorted(map(str, dealt.values())) != sorted(map(str, key["methods"])):
            raise UserError(f"{options.key}: does not say which letter of {scene} is which; expected a key of `page`")
    result = aggregate(key, {path: read_json(path, "answers that the page left") for path in options.answers})
    print(markdown(result))
    if options.json is not None:
        write_json(options.json, result | {"paper": TABLE2})


def make_page(options: Page) -> None:
    key_file = options.output.with_suffix(".key.json")
    for path in (options.output, key_file):
        if is_taken(path):
            raise UserError(f"{path}: exists, and answers may depend on it; expected a new name for the page")
    files = _media(options.media)
    methods = [name for name in files if name != INPUT]
    rng = np.random.default_rng(options.seed)
    letters = [chr(ord("A") + index) for index in range(len(methods))]
    key: dict[str, dict[str, str]] = {}
    scenes = []
    for index, scene in enumerate(rng.permutation(sorted(files[methods[0]])).tolist()):
        name = f"Scene {index + 1}"
        key[name] = dict(zip(letters, rng.permutation(methods).tolist(), strict=True))
        shown = {letter: files[method][scene] for letter, method in key[name].items()}
        if INPUT in files:
            shown = {INPUT: files[INPUT][scene]} | shown
        scenes.append({"name": name, "media": {k: data_url(path.read_bytes(), path.name) for k, path in shown.items()}})
    study = f"{options.output.stem}-{hashlib.sha256(json.dumps(key).encode()).hexdigest()[:8]}"
    data = {"study": study, "kind": options.kind, "criteria": CRITERIA, "letters": letters, "scenes": scenes}
    with replacing(options.output) as temporary:  # both files are written, or none
        write_page(temporary, Path(__file__).with_suffix(".html"), data)
        write_json(key_file, {"study": study, "methods": methods, "key": key})
    print(
        f"wrote {options.output}, {len(scenes)} scenes of {len(methods)} methods, and {key_file}: keep that from judges"
    )


def _media(folder: Path) -> dict[str, dict[str, Path]]:
    """The files by method and scene."""
    methods = sorted(path for path in folder.glob("*") if path.is_dir())
    files = {method.name: _scenes(method) for method in methods}
    if len(files.keys() - {INPUT}) < 2:
        raise UserError(f"{folder}: expected folders of at least two methods, METHOD/SCENE.mp4")
    scenes = set.union(*map(set, files.values()))
    for name, found in files.items():
        if scenes - found.keys():
            raise UserError(f"{folder / name}: has no {min(scenes - found.keys())}; expected every scene of the others")
    if not scenes:
        raise UserError(f"{folder}: its folders hold no pictures or videos; expected {', '.join(SUFFIXES)}")
    return files


def _scenes(method: Path) -> dict[str, Path]:
    """A method's files by scene."""
    files: dict[str, Path] = {}
    for path in sorted(path for path in method.iterdir() if path.suffix.lower() in SUFFIXES):
        if files.setdefault(path.stem, path) != path:
            raise UserError(f"{path}: is there beside {files[path.stem].name}; expected one file per scene")
    return files


def aggregate(key: dict[str, Any], answers: dict[Path, dict[str, Any]]) -> dict[str, Any]:
    """Shares of choices (percent) and mean ratings by method and criterion, each with its confidence interval.

    Args:
        key: as `make_page` writes it.
        answers: of each participant, by file. Unanswered questions do not count.

    Raises:
        UserError: there are no answers, or a file is for another page, by a participant with several files, or holds
            answers that the page does not offer.
    """
    methods, people = key["methods"], [_counts(key, path, content) for path, content in answers.items()]
    names = [content["participant"] for content in answers.values()]
    if not people:
        raise UserError("no file with answers was named; expected those that the page left")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UserError(f"{twice!r} has given several of these files; expected one for each person")
    chosen, choices, rated, ratings = (np.stack(part).astype(float) for part in zip(*people, strict=True))
    rng = np.random.default_rng(0)
    drawn = rng.multinomial(len(people), np.full(len(people), 1 / len(people)), RESAMPLES).astype(float)
    return {
        "participants": len(people),
        "interval": f"{COVERAGE:.0%}, bootstrap over participants, {RESAMPLES} resamples",
        "chosen": _with_interval(methods, 100 * chosen, np.repeat(choices[:, None], len(methods), 1), drawn),
        "rating": _with_interval(methods, rated, ratings, drawn),
    }


def _counts(key: dict[str, Any], path: Path, content: dict[str, Any]) -> tuple[np.ndarray, ...]:
    """One participant's choices [M 5] and their number [5], and sums of ratings [M 5] and their number [M 5]."""
    if content.get("study") != key["study"]:
        raise UserError(f"{path}: answers to {content.get('study')!r}; expected answers to {key['study']!r}")
    methods = key["methods"]
    chosen, choices = np.zeros((len(methods), len(CRITERIA))), np.zeros(len(CRITERIA))
    rated, ratings = np.zeros_like(chosen), np.zeros_like(chosen)
    seen = set()
    try:
        for answer in content["answers"]:
            criterion, scene = answer["criterion"], answer["scene"]
            if criterion not in range(len(CRITERIA)) or (scene, criterion) in seen:
                raise ValueError
            seen.add((scene, criterion))
            dealt = key["key"][scene]
            if "best" in answer:
                chosen[methods.index(dealt[answer["best"]]), criterion] += 1
                choices[criterion] += 1
            for letter, rating in answer.get("ratings", {}).items():
                if rating not in range(RATINGS[0], RATINGS[1] + 1):
                    raise ValueError
                rated[methods.index(dealt[letter]), criterion] += rating
                ratings[methods.index(dealt[letter]), criterion] += 1
        assert isinstance(content["participant"], str)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, AssertionError):
        raise UserError(f"{path}: holds answers that the page does not offer; expected a file that it left") from None
    return chosen, choices, rated, ratings


def _with_interval(methods: Sequence[str], sums: np.ndarray, counts: np.ndarray, drawn: np.ndarray) -> dict[str, Any]:
    """Sums [P M 5] over counts for all participants, with the interval over bootstrap resamples `drawn` [R P]."""
    with np.errstate(invalid="ignore"):  # NaN where nobody answered
        mean = sums.sum(0) / counts.sum(0)
        again = np.einsum("rp,pmc->rmc", drawn, sums) / np.einsum("rp,pmc->rmc", drawn, counts)
    tail = 100 * (1 - COVERAGE) / 2
    found: dict[str, Any] = {method: [] for method in methods}
    for m, method in enumerate(methods):
        for c in range(len(CRITERIA)):
            some = again[:, m, c][np.isfinite(again[:, m, c])]
            low, high = np.percentile(some, (tail, 100 - tail)) if len(some) else (np.nan, np.nan)
            cell = {"value": mean[m, c], "low": low, "high": high} if len(some) else None
            found[method].append(cell and {name: float(value) for name, value in cell.items()})
    return found


def markdown(result: dict[str, Any]) -> str:
    """Table 2: a row for each method, a column for each criterion, and the paper's own rows."""
    lines = [["", *(f"Criterion ({numeral})" for numeral in NUMERALS)], ["---"] * (1 + len(CRITERIA))]
    for method, shares in result["chosen"].items():
        cells = zip(shares, result["rating"][method], strict=True)
        lines.append([method, *(f"{_text(share, 1)} / {_text(rating, 2)}" for share, rating in cells)])
    for method, pairs in TABLE2.items():
        lines.append([f"paper: {method}", *(f"{share:.1f} / {rating:.2f}" for share, rating in pairs)])
    return f"{table_rows(lines)}\n{result['participants']} participants; in brackets {result['interval']}.\n"


def _text(cell: dict[str, float] | None, digits: int) -> str:
    return "–" if cell is None else "{value:.{d}f} [{low:.{d}f}, {high:.{d}f}]".format(d=digits, **cell)


if __name__ == "__main__":
    command_line.run(main, sys.argv[1:])
