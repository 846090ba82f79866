"""`l2dgs COMMAND` and `python -m l2dgs_jax.COMMAND`."""

import contextlib
import os
import signal
import subprocess
import sys
import warnings

import jax
import pytest

from l2dgs_jax.__main__ import COMMANDS
from l2dgs_jax.errors import OUT_OF_MEMORY
from l2dgs_jax.runtime import command_line
from l2dgs_jax.runtime.files import replacing


def run(*arguments):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True)


def test_help_lists_the_commands():
    done = run("-m", "l2dgs_jax", "--help")
    assert done.returncode == 0
    assert all(f"\n  {name} " in done.stdout for name in COMMANDS)
    assert run("-m", "l2dgs_jax").stdout == done.stdout


def test_an_unknown_command_is_refused_in_one_sentence():
    done = run("-m", "l2dgs_jax", "trian")
    assert done.returncode == 2
    assert done.stderr.startswith("error: trian: no such command; expected one of train, evaluate")
    assert done.stderr.count("\n") == 1


def test_both_ways_to_call_a_command_do_the_same(tmp_path):
    for name, way in (("a", ["l2dgs_jax.convert"]), ("b", ["l2dgs_jax", "convert"])):
        done = run("-m", *way, "demo", str(tmp_path / name), "--to", "transforms")
        assert done.returncode == 0, done.stderr
    a, b = (sorted(p.relative_to(tmp_path / name) for p in (tmp_path / name).rglob("*")) for name in "ab")
    assert a == b
    assert len(a) > 44


@pytest.mark.parametrize("way", [["l2dgs_jax.convert"], ["l2dgs_jax", "convert"]], ids=["module", "script"])
def test_a_mistake_is_reported_in_one_sentence_either_way(way, tmp_path):
    done = run("-m", *way, str(tmp_path / "nonsuch"), str(tmp_path / "out"), "--to", "llff")
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


def test_help_names_the_program_that_was_called():
    assert "usage: l2dgs convert" in run("-m", "l2dgs_jax", "convert", "--help").stdout
    assert "usage: python -m l2dgs_jax.convert" in run("-m", "l2dgs_jax.convert", "--help").stdout


def test_a_warning_is_printed_as_one_sentence(capsys):
    def command(arguments):
        warnings.simplefilter("default")
        warnings.warn("it is slow", RuntimeWarning, stacklevel=1)

    command_line.run(command, [])
    assert capsys.readouterr().err == "warning: it is slow\n"


def test_running_out_of_memory_is_reported_in_one_sentence(capsys):
    def command(arguments):
        raise MemoryError

    with pytest.raises(SystemExit) as stop:
        command_line.run(command, [])
    assert stop.value.code == OUT_OF_MEMORY
    assert capsys.readouterr().err.startswith("error: out of memory")


def test_a_cache_that_cannot_be_written_is_reported_once_and_not_used(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("L2DGS_JAX_CACHE", str(tmp_path / "file" / "cache"))
    before = jax.config.jax_compilation_cache_dir
    command_line.run(lambda _: None, [])
    assert jax.config.jax_compilation_cache_dir == before
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"warning: {tmp_path / 'file' / 'cache'}: not writable")


@pytest.mark.parametrize(("handler", "ends"), [(signal.SIG_DFL, True), (signal.SIG_IGN, False)])
def test_a_command_that_is_terminated_removes_what_is_half_written(tmp_path, handler, ends):
    def command(arguments):
        with replacing(tmp_path / "file.txt") as temporary:
            temporary.write_text("half")
            os.kill(os.getpid(), signal.SIGTERM)
            temporary.write_text("whole")

    before = signal.signal(signal.SIGTERM, handler)
    try:
        with pytest.raises(SystemExit) if ends else contextlib.nullcontext() as stop:
            command_line.run(command, [])
        assert signal.getsignal(signal.SIGTERM) == handler
    finally:
        signal.signal(signal.SIGTERM, before)
    if ends:
        assert stop.value.code == 128 + signal.SIGTERM
    assert [path.read_text() for path in tmp_path.iterdir()] == ([] if ends else ["whole"])


PRINTS = "print('x' * 100_000)"
MISTAKE = "from l2dgs_jax.errors import UserError; raise UserError('no such file')"


@pytest.mark.parametrize(
    ("program", "code", "said"),
    [
        ("from l2dgs_jax import evaluate; evaluate.main(['--help'])", 128 + signal.SIGPIPE, b""),
        (PRINTS, 128 + signal.SIGPIPE, b""),
        (MISTAKE, 2, b"error: no such file\n"),
    ],
    ids=["help", "output", "mistake"],
)
def test_a_reader_that_has_seen_enough_is_no_error_and_hides_none(program, code, said):
    script = f"from l2dgs_jax.runtime import command_line\ncommand_line.run(lambda _: exec({program!r}), [])"
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        running.stdout.close()  # before anything is written
        assert running.stderr.read() == said
    assert running.returncode == code
