"""The report page of a training, and its events for TensorBoard."""

import json
import re
import sys

import numpy as np
import pytest
from browser import result_of

from l2dgs_jax.data.images import to_bytes
from l2dgs_jax.errors import UserError
from l2dgs_jax.runs import METRICS, previews, report
from l2dgs_jax.runs.report import REPORT, Report
from l2dgs_jax.runs.tensorboard import EVENTS_FOLDER, TensorBoard

STEPS = 1200


def line(step):
    stage = "coarse" if step <= 100 else "fine"
    rates = {"means": 1e-4 * 0.99**step, "lifetimes": 0.0}
    values = {"loss": 5 / step, "psnr": 20 + step / 100, "l1": 1 / step, "ssim": 4 / step, "memory": 1.5}
    facts = {
        "step": step,
        "stage": stage,
        "gaussians": 100 + step,
        "pairs": 7,
        "rate_factor": 1.0,
        "seconds": 0.1 * step,
    }
    return {**facts, **values, "rates": rates}


def page_data(folder):
    page = (folder / REPORT).read_text()
    return json.loads(re.search(r'id="data">(.*?)</script>', page, re.S)[1])


def send_events(display, folder, first, last):
    """Send a display the events of a training after step `first`, up to step `last`."""
    display("start", scene="<toys> DATA", run=str(folder), step=first, steps=STEPS)
    display("begin", step=first, steps=STEPS)
    display("compiling", stage="coarse")
    for step in range(first + 1, last + 1):
        display("step", step=step, stage=line(step)["stage"], left=0.2 * (STEPS - step))
        if step % 10 == 0:
            with open(folder / METRICS, "a") as file:
                file.write(json.dumps(line(step)) + "\n")
            display("metrics", **line(step))


def write_previews(folder, step):
    for view in previews.VIEWS:
        for kind, level in (("lowlight", 0.1), ("welllit", 0.7)):
            previews._write(previews._path(folder, view, kind, step), to_bytes(np.full((24, 32, 3), level)))
        previews._write(previews._path(folder, view, previews.INPUT), to_bytes(np.full((24, 32, 3), 0.1)))


def test_the_page_keeps_the_whole_history_after_an_interruption(tmp_path):
    send_events(Report(tmp_path), tmp_path, 0, 400)
    display = Report(tmp_path)
    send_events(display, tmp_path, 400, 700)
    write_previews(tmp_path, 300)
    display("previews", step=300, files=[])
    data = page_data(tmp_path)
    assert data["curves"]["step"] == list(range(10, 701, 10))
    assert data["curves"]["terms"]["l1"] == pytest.approx([1 / step for step in range(10, 701, 10)])
    assert data["curves"]["rates"].keys() == {"means", "lifetimes"}
    assert data["curves"]["fine"] == 110
    assert [view["steps"]["300"].keys() for view in data["views"]] == [{"lowlight", "welllit"}] * 2
    assert (data["state"], data["step"], data["running"]) == ("fine stage", 700, True)
    assert data["left"] == pytest.approx(100)


def test_the_page_shows_the_end_and_needs_no_other_file_or_server(tmp_path):
    display = Report(tmp_path)
    send_events(display, tmp_path, 0, 200)
    display("diverged", message="going back", step=100, rate_factor=0.5)
    display("end", code=143, reason="stopped after step 200 of 1200; go on with: </script>")
    data, page = page_data(tmp_path), (tmp_path / REPORT).read_text()
    assert not data["running"]
    assert data["state"].endswith("</script>")
    assert data["note"] == "going back"
    assert "<title>&lt;toys&gt; DATA: training</title>" in page
    assert not re.search(r"https?://(?!www\.w3\.org)|<link|<script src|@import|fetch\(", page)


def test_the_page_is_written_at_intervals_only(tmp_path, monkeypatch):
    now, written = 1000.0, []
    monkeypatch.setattr(report.time, "monotonic", lambda: now)
    monkeypatch.setattr(Report, "write", lambda self: written.append(now))
    display = Report(tmp_path)
    display("begin", step=0, steps=STEPS)
    for step in range(1, 101):
        now += 1
        display("step", step=step, stage="coarse", left=None)
    assert len(written) == 1 + 100 // report.WRITE_INTERVAL


def test_a_page_that_cannot_be_written_does_not_end_the_training(tmp_path):
    (tmp_path / REPORT).mkdir()
    send_events(Report(tmp_path), tmp_path, 0, 20)
    with pytest.raises(UserError, match=r"report\.html"):
        Report(tmp_path).write()


def test_curves_of_a_long_run_are_thinned_and_values_not_finite_are_gaps():
    lines = [line(step) for step in range(10, 23_001, 10)]
    lines[-1]["psnr"] = float("inf")
    del lines[-6]["rates"]
    curves = report.curves(lines)
    assert report.CURVE_POINTS <= len(curves["step"]) < 2 * report.CURVE_POINTS
    assert curves["step"][-1] == 23_000
    assert curves["psnr"][-1] is None
    assert curves["rates"]["means"][-2] is None
    json.dumps(curves, allow_nan=False)


def test_pictures_of_lost_steps_are_dropped(tmp_path):
    write_previews(tmp_path, 300)
    write_previews(tmp_path, 600)
    unfinished = tmp_path / previews.PREVIEWS / "training" / "welllit-000900.tmp.jpg"
    unfinished.write_bytes(b"")
    previews.drop_after(tmp_path, 300)
    assert {(found.kind, found.step) for found in previews.kept(tmp_path)} == {
        ("input", None),
        ("lowlight", 300),
        ("welllit", 300),
    }


def test_tensorboard_has_scalars_and_pictures_and_purges_lost_steps(tmp_path):
    display = TensorBoard(tmp_path)
    send_events(display, tmp_path, 0, 50)
    write_previews(tmp_path, 40)
    display("previews", step=40, files=[])
    display("diverged", message="going back", step=30)
    send_events(display, tmp_path, 30, 60)
    display("end", code=0)
    tags, purged = {}, []
    for path in sorted((tmp_path / EVENTS_FOLDER).iterdir()):
        for event in events(path):
            if event.session_log.status:
                purged.append(event.step)
            for value in event.summary.value:
                tags.setdefault(value.tag, []).append(event.step)
    assert purged == [1, 31]
    assert tags["loss"] == [10, 20, 30, 40, 50, 40, 50, 60]
    assert {"psnr", "gaussians", "memory", "terms/l1", "rates/means"} < tags.keys()
    assert tags["held-out/welllit"] == tags["training/lowlight"] == [40]


def events(path):
    """Events of a file of records: 8 bytes of length, 4 of its checksum, the record, 4 of its checksum."""
    from tensorboardX.proto.event_pb2 import Event

    content = path.read_bytes()
    while content:
        end = 12 + int.from_bytes(content[:8], "little")
        yield Event.FromString(content[12:end])
        content = content[end + 4 :]


def test_without_the_extra_tensorboard_is_refused_in_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(UserError, match=r'^tensorboardX .* for --tensorboard: pip install "l2dgs-jax\[tensorboard\]"$'):
        TensorBoard(tmp_path)


@pytest.mark.slow
@pytest.mark.usefixtures("chromium")
def test_a_browser_draws_the_page(tmp_path):
    display = Report(tmp_path)
    send_events(display, tmp_path, 0, 600)
    write_previews(tmp_path, 300)
    write_previews(tmp_path, 600)
    display("end", code=0)
    drawn = result_of(tmp_path / REPORT, "return document.documentElement.outerHTML", tmp_path)
    assert "&lt;toys&gt; DATA" in drawn
    assert "finished, step 600 of 1200" in drawn
    assert drawn.count("<svg") == 4 + 2 + 2
    assert drawn.count('src="data:image/jpeg') == 6
    assert re.search(r"<b>600</b>", drawn)
