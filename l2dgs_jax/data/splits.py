"""Which frames are held out, and the frames' instants: as the scene's files say, or else by rules."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from l2dgs_jax.data.parsing import name_list, numbers, read_json, value
from l2dgs_jax.errors import UserError

Lists = tuple[list[str], list[str]]  # names to train on, names held out
NO_LISTS: Lists = ([], [])

_DIGITS = re.compile(r"[0-9]+")
_DECIMAL = re.compile(r"([0-9]+)\.([0-9]+)")
_CAMERA = re.compile(r"(?<![a-z])(camera|cam|view|c|v)[-_ ]?[0-9]+", re.IGNORECASE)  # "cam01", not "frame01"


def check_rule(rule: str) -> None:
    """Check that `hold_out` knows the rule.

    Raises:
        UserError: it does not.
    """
    if rule not in ("auto", "4dgs") and not (re.fullmatch(r"[0-9]{1,6}", rule) and int(rule) >= 2):
        raise UserError(f"--held-out {rule}: expected auto, 4dgs, or a whole number k from 2 for every k-th frame")


def hold_out(
    source: str, names: Sequence[str], own: Lists, rule: str, default: str
) -> tuple[list[str], list[str], tuple[str, ...]]:
    """Names to train on and names held out, and a note if frames are in neither or in both.

    Args:
        source: the file that lists the frames, for messages.
        names: all frames in order.
        own: the scene's own lists, empty if it has none.
        rule: "auto" (the scene's own lists, or else the default rule), "4dgs" (arXiv 2310.08528: train on every fourth
            frame, hold out those halfway between), or a number k: the first and then every k-th frame are held out,
            and the others trained on (3DGS, arXiv 2308.04079, with 8).
        default: the rule for scenes of this layout without lists.

    Raises:
        UserError: there are too few frames to train on or held out.
    """
    notes: tuple[str, ...] = ()
    if rule == "auto" and own[1]:
        train, test = (list(dict.fromkeys(part)) for part in own)
        unseen = [name for name in train if name not in test]
        if 2 <= len(unseen) < len(train):
            notes = (f"{source}: {len(train) - len(unseen)} frames are listed in both ways; they are held out",)
            train = unseen
        elif len(unseen) < len(train):
            notes = (f"{source}: what is held out is also trained on, so its scores are not those of unseen views",)
    else:
        rule = default if rule == "auto" else rule
        if rule == "4dgs":
            train, test = list(names[::4]), list(names[2::4][: (len(names) - 1) // 4])
        else:
            test = list(names[:: int(rule)])
            train = [name for i, name in enumerate(names) if i % int(rule)]
        used = len(train) + len(test)
        if used < len(names):
            notes = (f"{used} of {len(names)} frames are used (held-out rule {rule})",)
    if len(train) < 2 or not test:
        raise UserError(
            f"{source}: {len(train)} frames to train with and {len(test)} held out, of {len(names)} listed; expected "
            "at least 2 and 1, or 5 in all if none is marked as held out"
        )
    return train, test, notes


def lists(folder: Path) -> tuple[list[str], Lists]:
    """Names of all frames, and those to train on and held out, from `dataset.json` or `splits/{train,val}.json`.

    Raises:
        UserError: neither exists, or one is malformed.
    """
    path = folder / "dataset.json"
    has_splits = (folder / "splits").is_dir()
    content = {} if has_splits and not path.exists() else read_json(path, "the lists of frames")
    ids: list[str] = []
    if has_splits and not {"ids", "train_ids"} & content.keys():
        files = (folder / "splits" / f"{part}.json" for part in ("train", "val"))
        train, test = (name_list(file, read_json(file, "a list of frames"), "frame_names") for file in files)
    else:
        ids = name_list(path, content, "ids") if "ids" in content else []
        test = name_list(path, content, "val_ids") if "val_ids" in content else []
        if "train_ids" in content or not ids:
            train = name_list(path, content, "train_ids")
        else:
            train = [name for name in ids if name not in test] if test else []
    return ids if {*train, *test} <= {*ids} else sorted({*train, *test}), (train, test)


def lists_beside(folder: Path, names: Sequence[str]) -> Lists:
    """The lists of a `dataset.json` in a scene whose own layout has none.

    Raises:
        UserError: it is malformed or lists frames that the scene does not have.
    """
    path = folder / "dataset.json"
    content = read_json(path, "the lists of frames") if path.exists() else {}
    if not {"train_ids", "val_ids"} & content.keys():
        return NO_LISTS
    if "train_ids" in content:
        own = lists(folder)[1]
    else:
        test = name_list(path, content, "val_ids")
        own = [name for name in names if name not in test], test
    unknown = sorted({*own[0], *own[1]} - {*names})
    if unknown:
        raise UserError(f"{path}: lists '{unknown[0]}', which the scene does not have; expected the scene's frames")
    return own


def instants(folder: Path, names: Sequence[str]) -> dict[str, float]:
    """The frames' instants in [0, 1].

    They come from `metadata.json`: "time", `normalised`, or else "warp_id" or "time_id", scaled to [0, 1]. Without it,
    they are the numbers in the names (see `numbers_in`), scaled likewise, if these differ; or else the order of the
    names.

    Raises:
        UserError: `metadata.json` is malformed, or has entries for some of the frames only.
    """
    path = folder / "metadata.json"
    metadata = read_json(path, "the frames' instants") if path.exists() else {}
    known = metadata.keys() & set(names)
    entries = [value(path, metadata, name, dict) for name in names] if known else []
    key = next((key for key in ("time", "warp_id", "time_id") if any(key in entry for entry in entries)), None)
    if key:
        moments = np.array([float(numbers(path, entry, key, ())) for entry in entries])
        moments = normalised(moments) if key == "time" else _spread(moments)
    else:
        moments = _spread(_from_names(names))
    return dict(zip(names, moments.tolist(), strict=True))


def normalised(times: Float[np.ndarray, " F"]) -> Float[np.ndarray, " F"]:
    """Times unchanged if they all lie in [0, 1], or else scaled to that range."""
    return times if times.min() >= 0 and times.max() <= 1 else _spread(times)


def _spread(values: Float[np.ndarray, " F"]) -> Float[np.ndarray, " F"]:
    if np.abs(values).max() > 1e300:
        values = values / 4  # so that no difference overflows
    return (values - values.min()) / (np.ptp(values) or 1.0)


def _from_names(names: Sequence[str]) -> Float[np.ndarray, " F"]:
    numbers = numbers_in(names)
    return np.array(numbers, float) if len(set(numbers)) > 1 else np.arange(len(names), dtype=float)


def numbers_in(names: Sequence[str]) -> list[int]:
    """The number in each name by which most names differ; empty if a name has none.

    Decimal fractions, such as of seconds, are of one number with what they follow, and all numbers are then given in
    units of their last digit. If names differ as much by several numbers, it is the last of these, or if they disagree
    on the order of the names, the one with the smallest range: frames are counted, other digits are those of a hash.
    Numbers of cameras, such as in "cam01_0005", do not count if others differ.
    """

    def most_different(names: Sequence[str]) -> list[int]:
        found = [[int(digits[-15:]) for digits in _DIGITS.findall(name)] for name in names]
        either_end = [row[::-1] for row in found], found
        columns = [list(column) for rows in either_end for column in zip(*rows, strict=False)]
        most = max((len(set(column)) for column in columns), default=0)
        tied = [column for column in columns if len(set(column)) == most]
        orders = {tuple(np.argsort(column, kind="stable")) for column in tied}
        return min(tied, key=np.ptp) if len(orders) > 1 else [*tied, []][0]

    names = _without_points(names)
    without_cameras = most_different([_CAMERA.sub("", name) for name in names])
    return without_cameras if len(set(without_cameras)) > 1 else most_different(names)


def _without_points(names: Sequence[str]) -> Sequence[str]:
    """The names with decimals as whole numbers, unless points only separate numbers, as in "1.9" and "1.10"."""
    decimals = [decimal for name in names for decimal in _DECIMAL.findall(name)]
    wholes, widths = {whole for whole, _ in decimals}, {len(fraction) for _, fraction in decimals}
    if len(widths) > 1 and len(wholes) == 1:
        return names
    return [_DECIMAL.sub(lambda found: found[1] + found[2].ljust(max(widths), "0"), name) for name in names]
