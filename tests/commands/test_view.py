"""The command that shows a run in the browser."""

import contextlib
import dataclasses
import os
import signal
import socket
import subprocess
import sys

import finished_run
import jax
import numpy as np
import pytest
from browser import awaited, opened

import l2dgs_jax
from l2dgs_jax import train
from l2dgs_jax.model.networks import init_bafe
from l2dgs_jax.runtime import command_line
from l2dgs_jax.view import main
from l2dgs_jax.viewer.panel import OUTPUT_NAMES

PICTURE = np.s_[160:, :-340]  # without viser's messages at the top and the controls at the right


def error_message(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        command_line.run(main, [*map(str, arguments)])
    assert end.value.code == 2
    return capsys.readouterr().err


def test_mistakes_are_reported_in_one_sentence(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("L2DGS_JAX_CACHE", "off")
    folder = finished_run.folder(tmp_path)
    assert "--port 0: expected a number" in error_message(capsys, folder, "--port", 0)
    assert "--host 192.0.2.1: " in error_message(capsys, folder, "--host", "192.0.2.1")
    assert "--host '': is empty; expected an address" in error_message(capsys, folder, "--host", "")
    with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", 65535)):  # if it is taken, so much the better
        assert "--port 65535: is in use" in error_message(capsys, folder, "--port", 65535)
    assert "not a training run" in error_message(capsys, tmp_path)
    monkeypatch.setitem(sys.modules, "viser", None)
    error = error_message(capsys, folder)
    assert error == 'error: viser is not installed; expected the extra for viewing: pip install "l2dgs-jax[view]"\n'


def test_invalid_view_options_of_a_training_leave_no_folder(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("L2DGS_JAX_CACHE", "off")
    for option, value in (("--view-port", "0"), ("--view-host", "192.0.2.1")):
        with pytest.raises(SystemExit):
            command_line.run(train.main, ["demo", "--output", str(tmp_path / "run"), "--view", option, value])
        assert f"{option} {value}: " in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def varied_run(folder):
    """A run whose images change over time, and whose exponents vary over the image."""
    run = finished_run.opened(folder)
    scene = run.state.scene
    planes = scene.params.hexplane.time
    rising = tuple(plane * np.linspace(0, 5, len(plane[0]), dtype=plane.dtype)[None, :, None, None] for plane in planes)
    bafe = jax.tree.map(lambda x: x.astype(planes[0].dtype), init_bafe(jax.random.key(0), None))
    params = scene.params._replace(hexplane=scene.params.hexplane._replace(time=rising), bafe=bafe)
    state = run.state._replace(scene=scene._replace(params=params))
    return l2dgs_jax.save_run(dataclasses.replace(run, state=state), folder / "moving").folder


def changed(page, before):
    """The picture, once it differs from `before` and no longer changes."""
    last = before

    def settled():
        nonlocal last
        previous, last = last, page.picture()[PICTURE].astype(int)
        return bool((last != before).any() and (last == previous).all())

    awaited(settled)
    return last


@pytest.mark.slow
@pytest.mark.usefixtures("chromium")
def test_a_browser_shows_what_its_controls_select(tmp_path):
    command = [sys.executable, "-m", "l2dgs_jax.view", str(varied_run(tmp_path)), "--port", "8917"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            address = next(word for line in server.stdout for word in line.split() if word.startswith("http://127"))
            with opened(address, tmp_path / "profile") as tab:
                page = tab()
                awaited(lambda: " ms" in page.text())
                first = changed(page, np.zeros(()))
                page.enter("Instant", "1")
                last = changed(page, first)
                page.enter("Brightness", "2")
                bright = changed(page, last)
                page.enter("Brightness", "0")
                dark = changed(page, bright)
                assert dark.mean() + 10 < last.mean() < bright.mean() - 10
                page.enter("Brightness", "1")
                maps = [changed(page, dark)]
                for name in list(OUTPUT_NAMES)[1:]:
                    page.choose("Show", name)
                    maps.append(changed(page, maps[-1]))
                assert len({shown.tobytes() for shown in maps}) == len(OUTPUT_NAMES)

                page.click("Filmed frames")
                page.click("Play")
                awaited(lambda: page.value("Instant") not in ("1", "0"))
                page.wheel((200, 300), 500)
                other = tab()
                awaited(lambda: " ms" in other.text())
                assert [other.value(name) for name in ("Instant", "Brightness", "Show")] == ["0", "1", "well-lit"]
                assert not page.complaints() + other.complaints()
                host = address.removeprefix("http://").rstrip(";")
                own_addresses = tuple(f"{scheme}{host}" for scheme in ("http://", "ws://", "blob:http://"))
                assert all(url.startswith((*own_addresses, "data:")) for url in page.addresses() + other.addresses())
        finally:
            server.send_signal(signal.SIGTERM)
        assert server.wait(timeout=20) == 0


@pytest.mark.slow
@pytest.mark.usefixtures("chromium")
def test_a_browser_shows_the_progress_of_a_training(tmp_path):
    finished_run.folder(tmp_path)
    command = [sys.executable, "-m", "l2dgs_jax.train", str(tmp_path / "tiny_scene"), "--output", str(tmp_path / "run")]
    small = ["--model.hidden=8", "--model.plane-size=4", "--model.plane-channels=2", "--model.no-tracks"]
    small += ["--model.no-surfaces"]
    steps = ["--coarse-steps=1", "--fine-steps=100000", "--devices=1", "--no-report", "--view", "--view-port=8927"]
    environment = os.environ | {"XLA_FLAGS": "--xla_backend_optimization_level=0"}
    with subprocess.Popen([*command, *small, *steps], env=environment, stderr=subprocess.PIPE, text=True) as training:
        try:
            address = next(line.split()[-1] for line in training.stderr if "http://127" in line)
            with opened(address, tmp_path / "profile") as tab:
                page = tab()
                awaited(lambda: " ms" in page.text())
                seen = [page.picture()[PICTURE]]
                for _ in range(2):
                    awaited(lambda: (page.picture()[PICTURE] != seen[-1]).any())
                    seen.append(page.picture()[PICTURE])
                assert not page.complaints()
        finally:
            training.send_signal(signal.SIGTERM)
            rest = training.stderr.read()
        assert training.wait(timeout=60) == 128 + signal.SIGTERM
        assert "go on with: " in rest
