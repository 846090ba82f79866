"""The user study: the table of answers, its intervals, and answers that are refused."""

import json

import numpy as np
import pytest
from scipy import stats

from experiments import user_study
from experiments.user_study import markdown
from experiments.user_study_statistics import aggregate, percentage, ratio
from l2dgs_jax.errors import UserError

KEY = {
    "study": "night-0",
    "kind": "both",
    "methods": ["ours", "theirs"],
    "scenes": {
        "s1": {"name": "moose", "letters": {"A": "ours", "B": "theirs"}},
        "s2": {"name": "otter", "letters": {"A": "theirs", "B": "ours"}},
    },
}
MORNING, EVENING = "2026-01-05T08:00:00.000Z", "2026-01-05T20:00:00.000Z"


def answer(scene, criterion, best=None, **ratings):
    return {"scene": scene, "criterion": criterion} | ({"best": best} if best else {}) | {"ratings": ratings}


def person(tmp_path, name, *answers, **other):
    content = {"study": "night-0", "id": f"browser of {name}", "participant": name, "saved": MORNING}
    return tmp_path / f"{name}.json", content | {"answers": list(answers)} | other


def test_letters_are_dealt_to_methods_anew_for_every_scene(tmp_path):
    """Choosing A everywhere is no preference: the letter stands for another method in each scene."""
    people = dict([person(tmp_path, "one", answer("s1", 0, "A", A=5, B=2), answer("s2", 0, "A", A=4, B=1))])
    found = aggregate(KEY, people)
    assert [found["chosen"][method][0]["value"] for method in KEY["methods"]] == [50, 50]
    assert [found["rating"][method][0]["value"] for method in KEY["methods"]] == [3, 3]
    assert found["chosen"]["ours"][1] is None, "nobody answered by that criterion"


def test_intervals_are_over_participants(tmp_path):
    """Two of three people prefer ours throughout; their many answers count as two people, not as many."""
    both = [answer(scene, 0, best) for scene, best in (("s1", "A"), ("s2", "B"))]
    neither = [answer(scene, 0, best) for scene, best in (("s1", "B"), ("s2", "A"))]
    few = dict(person(tmp_path, name, *given) for name, given in (("a", both), ("b", both), ("c", neither)))
    cell = aggregate(KEY, few)["chosen"]["ours"][0]
    assert cell["value"] == pytest.approx(200 / 3)
    assert (cell["low"], cell["high"]) == (0, 100)
    many = dict(person(tmp_path, f"{i}", *given) for i, given in enumerate([both, neither] * 60))
    wide = aggregate(KEY, many)["chosen"]["ours"][0]
    # 1.96 standard deviations of a mean of 120 people, half of whom say 100
    assert wide["high"] - wide["low"] == pytest.approx(2 * 1.96 * 50 / np.sqrt(120), rel=0.02)


def test_the_interval_is_students_where_all_give_as_many_answers():
    sums, counts = np.array([12.0, 19, 5, 0]), np.array([4.0, 4, 4, 0])  # the last person gave none
    cell = ratio(sums, counts, (-10, 10))
    expected = stats.ttest_1samp(sums[:3] / 4, 0).confidence_interval(0.95)
    assert [cell["value"], cell["low"], cell["high"]] == pytest.approx([3, expected.low, expected.high])
    clipped = ratio(sums, counts, (1, 5))
    assert (clipped["low"], clipped["high"]) == (1, 5)


@pytest.mark.parametrize(
    ("people", "share", "bounds"), [(8, 1, (63.06, 100)), (8, 0, (0, 36.94)), (2, 1, (15.81, 100))]
)
def test_agreement_of_few_is_not_certainty(people, share, bounds):
    """The bounds are those of Clopper and Pearson's tables, with people as trials however much each has answered."""
    counts = np.arange(1.0, people + 1)
    cell = percentage(counts * share, counts)
    assert (cell["low"], cell["high"]) == pytest.approx(bounds, abs=0.01)


@pytest.mark.parametrize(
    ("estimate", "sums", "counts"),
    [
        (percentage, (2, 0), (3, 0)),  # one person
        (percentage, (2, 0), (2, 0)),
        (percentage, (1, 2), (2, 4)),
        (lambda *given: ratio(*given, (1, 5)), (10, 20), (3, 6)),
        (lambda *given: ratio(*given, (1, 5)), (10, 5), (2, 1)),
    ],
)
def test_no_interval_is_claimed_without_spread_to_judge_it_by(estimate, sums, counts):
    cell = estimate(np.array(sums, float), np.array(counts, float))
    assert cell == {"value": cell["value"], "low": None, "high": None}


def test_intervals_of_few_people_hold_the_truth_as_often_as_they_say():
    """Three people whose preferences differ, and who leave some of 12 scenes out; resampling them reaches 72 %."""
    rng = np.random.default_rng(0)
    held = []
    for _ in range(300):
        counts = rng.binomial(12, 0.9, 3)
        cell = percentage(rng.binomial(counts, rng.beta(3, 2, 3)).astype(float), counts.astype(float))
        held.append(cell["low"] <= 60 <= cell["high"] if cell["low"] is not None else True)
    assert 0.9 < np.mean(held) < 0.99


def test_the_table_has_the_form_of_table_2(tmp_path):
    given = [answer("s1", c, "A", A=5, B=2) for c in range(5)]
    people = dict([person(tmp_path, "one", *given), person(tmp_path, "two", *given)])
    lines = markdown(aggregate(KEY, people)).splitlines()
    assert lines[0].strip("| ").split(" | ") == [f"Criterion ({numeral})" for numeral in ("i", "ii", "iii", "iv", "v")]
    assert lines[2].startswith("| ours | 100.0 [15.8, 100.0] / 5.00 |")
    assert lines[-3].startswith("| paper: L2DGS | 75.2 / 4.05 | 93.6 / 4.33 |")
    assert lines[-1].startswith("Participants: 2. In brackets: 95 % confidence intervals over people, by Student's t")


def test_the_table_is_written_as_json_with_null_for_no_interval(tmp_path, capsys):
    path, content = person(tmp_path, "one", answer("s1", 0, "A"))
    for file, data in ((path, content), (tmp_path / "key.json", KEY)):
        file.write_text(json.dumps(data))
    user_study.main(["table", str(tmp_path / "key.json"), str(path), "--json", str(tmp_path / "table.json")])
    assert "| ours | 100.0 / – |" in capsys.readouterr().out
    found = json.loads((tmp_path / "table.json").read_text())
    assert found["chosen"]["ours"][:2] == [{"value": 100, "low": None, "high": None}, None]


@pytest.mark.parametrize(
    ("given", "naming"),
    [
        ({"study": "other-1"}, "other-1"),
        ({"answers": [answer("s3", 0, "A")]}, "does not offer"),
        ({"answers": [answer("s1", 5, "A")]}, "does not offer"),
        ({"answers": [answer("s1", -1, "A")]}, "does not offer"),
        ({"answers": [answer("s1", 0, "A"), answer("s1", 0, "A")]}, "does not offer"),
        ({"answers": [answer("s1", 0, "C")]}, "does not offer"),
        ({"answers": [answer("s1", 0, A=6)]}, "does not offer"),
        ({"answers": [answer("s1", 0, A=2.5)]}, "does not offer"),
        ({"answers": 3}, "does not offer"),
        ({"answers": [{**answer("s1", 0), "ratings": [1, 2]}]}, "does not offer"),
        ({"participant": None}, "does not offer"),
        ({"id": 7}, "does not offer"),
        ({"saved": None}, "does not offer"),
    ],
)
def test_answers_to_something_else_are_refused(tmp_path, given, naming):
    path, content = person(tmp_path, "one", answer("s1", 0, "A"))
    with pytest.raises(UserError, match=r"one\.json") as caught:
        aggregate(KEY, {path: content | given})
    assert naming in str(caught.value)


@pytest.mark.parametrize(("kind", "unasked"), [("binary", answer("s1", 0, A=3)), ("rating", answer("s1", 0, "A"))])
def test_answers_of_a_kind_that_was_not_asked_for_are_refused(tmp_path, kind, unasked):
    with pytest.raises(UserError, match=r"one\.json: holds answers that the page does not offer"):
        aggregate(KEY | {"kind": kind}, dict([person(tmp_path, "one", unasked)]))


@pytest.mark.parametrize("last", [0, 1])
def test_of_files_from_one_browser_the_one_saved_last_counts(tmp_path, capsys, last):
    """Also if the person has changed their name in between, and whichever file is named first."""
    times = [EVENING, MORNING] if last == 0 else [MORNING, EVENING]
    files = [
        person(tmp_path, name, answer("s1", 0, best), id="same", saved=saved)
        for name, best, saved in zip(("ann", "anna"), "AB", times, strict=True)
    ]
    found = aggregate(KEY, dict(files))
    assert found["participants"] == 1
    assert found["chosen"][KEY["methods"][last]][0]["value"] == 100
    kept, dropped = files[last][0], files[1 - last][0]
    assert capsys.readouterr().err == f"{dropped}: left out, because {kept} was saved later in that browser\n"


def test_one_name_in_two_browsers_is_refused(tmp_path):
    one, other = (person(tmp_path, name, answer("s1", 0, "A")) for name in ("one", "other"))
    other[1]["participant"] = " ONE"
    with pytest.raises(UserError, match=r'other\.json: .*one\.json, but .*another "participant" .* only one'):
        aggregate(KEY, dict([one, other]))
    other[1]["participant"] = "One B."
    assert aggregate(KEY, dict([one, other]))["participants"] == 2


def test_who_gave_no_answers_is_no_participant(tmp_path, capsys):
    """Nor does their name stand in the way of a file with answers."""
    silent, content = person(tmp_path, "silent", participant="one")
    found = aggregate(KEY, dict([person(tmp_path, "one", answer("s1", 0, A=2)), (silent, content)]))
    assert found["participants"] == 1
    assert capsys.readouterr().err == f"{silent}: left out, because it holds no answers\n"
    with pytest.raises(UserError, match="no file with answers"):
        aggregate(KEY, {silent: content})


@pytest.mark.parametrize("change", [{"study": 0}, {"kind": 0}, {"methods": None}, {"scenes": []}])
def test_malformed_keys_and_answers_are_refused(tmp_path, change):
    path, answers = person(tmp_path, "one", answer("s1", 0, "A"))
    for file, content in ((path, answers), (tmp_path / "key.json", KEY | change)):
        file.write_text(json.dumps(content))
        with pytest.raises(UserError, match=rf"{file.name}: '(kind|{next(iter(change))})'"):
            user_study.main(["table", str(file), str(path)])
