"""The user study of Table 2: a page on which methods are judged blindly, and the table of the answers.

    python -m experiments.user_study page MEDIA study.html --seed 1     # MEDIA/METHOD/SCENE.mp4 (or .webm, .png ...)
    python -m experiments.user_study table study.key.json answers/*.json

The page is self-contained and works offline; each participant downloads their answers from it as a file. Methods are
shown as letters, which are dealt at random for every scene; only the key file says which method is which. Do not give
that file to the participants. Scenes and letters are shown in an order that the page draws for each participant.
"""

import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import tyro

from experiments.markdown import table_rows
from experiments.published import TABLE2
from experiments.user_study_statistics import CRITERIA, Estimate, aggregate
from experiments.web_page import write_page
from l2dgs_jax.data import images
from l2dgs_jax.data.parsing import read_json, value
from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import is_taken, replacing, write_json
from l2dgs_jax.runtime.pages import data_url

VIDEOS = (".mp4", ".webm")
SUFFIXES = VIDEOS + images.SUFFIXES
INPUT = "input"  # folder in MEDIA that is shown beside the methods but not judged
NUMERALS = ("i", "ii", "iii", "iv", "v")


@dataclass(frozen=True)
class Page:
    """Make a page from the folders of several methods, each with one picture or video of every scene.

    Attributes:
        media: folder that contains the methods' folders; one called "input" is shown for comparison.
        output: the page, .html; its key file is written beside it.
        seed: of the random letters of the methods in each scene.
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

    In brackets are 95 % confidence intervals over participants, because answers of one person are not independent: by
    Student's t or, where all agree on 0 or 100 %, Clopper-Pearson's. Where people are too few for an interval, or all
    gave the same mean rating, there are no brackets.

    Attributes:
        key: key file that `page` wrote.
        answers: files downloaded from the page. Of several from one browser, the one saved last counts.
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
    key = _read_key(options.key)
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
    key: dict[str, Any] = {"kind": options.kind, "seed": options.seed, "methods": methods, "scenes": {}}
    scenes = []
    for index, scene in enumerate(sorted(files[methods[0]])):
        dealt = dict(zip(letters, rng.permutation(methods).tolist(), strict=True))
        shown = {INPUT: files[INPUT][scene]} if INPUT in files else {}
        shown |= {letter: files[method][scene] for letter, method in dealt.items()}
        _expect_alike(list(shown.values()))
        neutral = f"s{index + 1}"
        key["scenes"][neutral] = {"name": scene, "letters": dealt}
        scenes.append({"name": neutral, "media": {label: _anonymous(path) for label, path in shown.items()}})
    data = {"kind": options.kind, "criteria": CRITERIA, "letters": letters, "scenes": scenes}
    study = f"{options.output.stem}-{hashlib.sha256(json.dumps([data, key]).encode()).hexdigest()[:8]}"
    with replacing(options.output) as temporary:  # both files are written, or none
        write_page(temporary, Path(__file__).with_suffix(".html"), {"study": study} | data)
        write_json(key_file, {"study": study} | key)
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


def _expect_alike(paths: Sequence[Path]) -> None:
    """Check that neither container nor size tells the files of a scene apart."""
    first, *others = [(path, _container(path), "x".join(map(str, _size(path)))) for path in paths]
    for path, container, size in others:
        if (container, size) != first[1:]:
            raise UserError(
                f"{path}: is a {container} of {size} pixels; expected a {first[1]} of {first[2]} like {first[0]}, "
                "so that participants cannot tell methods apart by it"
            )


def _container(path: Path) -> str:
    return f"{path.suffix.lower()} video" if path.suffix.lower() in VIDEOS else "picture"


def _size(path: Path) -> tuple[int, int]:
    """Width and height."""
    if _container(path) == "picture":
        return images.read_header(path).size
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise UserError(f"{path}: not a video that OpenCV can read; expected {' or '.join(VIDEOS)}")
    return int(video.get(cv2.CAP_PROP_FRAME_WIDTH)), int(video.get(cv2.CAP_PROP_FRAME_HEIGHT))


def _anonymous(path: Path) -> str:
    """A data URL: a picture's pixels without its metadata, or a video as it is."""
    if _container(path) != "picture":
        return data_url(path.read_bytes(), path.name)
    _, content = cv2.imencode(".png", images.to_bytes(images.read_image(path))[..., ::-1])
    return data_url(content.tobytes(), "picture.png")


def _read_key(path: Path) -> dict[str, Any]:
    key = read_json(path, "a key that `page` wrote")
    for entry, kind in {"study": str, "kind": str, "methods": list, "scenes": dict}.items():
        value(path, key, entry, kind)
    for name, scene in key["scenes"].items():
        letters = scene.get("letters") if isinstance(scene, dict) else None
        if not isinstance(letters, dict) or sorted(map(str, letters.values())) != sorted(map(str, key["methods"])):
            raise UserError(f"{path}: does not say which letter of {name} is which; expected a key of `page`")
    return key


def markdown(result: dict[str, Any]) -> str:
    """Table 2: a row for each method, a column for each criterion, and the paper's own rows."""
    lines = [["", *(f"Criterion ({numeral})" for numeral in NUMERALS)], ["---"] * (1 + len(CRITERIA))]
    for method, shares in result["chosen"].items():
        cells = zip(shares, result["rating"][method], strict=True)
        lines.append([method, *(f"{_text(share, 1)} / {_text(rating, 2)}" for share, rating in cells)])
    for method, pairs in TABLE2.items():
        lines.append([f"paper: {method}", *(f"{share:.1f} / {rating:.2f}" for share, rating in pairs)])
    return f"{table_rows(lines)}\nParticipants: {result['participants']}. In brackets: {result['interval']}.\n"


def _text(cell: Estimate | None, digits: int) -> str:
    if cell is None:
        return "–"
    bounds = "" if cell["low"] is None else f" [{cell['low']:.{digits}f}, {cell['high']:.{digits}f}]"
    return f"{cell['value']:.{digits}f}{bounds}"


if __name__ == "__main__":
    command_line.run(main, sys.argv[1:])
