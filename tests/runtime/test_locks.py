"""A folder in which one process works at a time."""

import errno
import os
import subprocess
import sys

import pytest

from l2dgs_jax.errors import UserError
from l2dgs_jax.runtime import locks
from l2dgs_jax.runtime.locks import LOCK, locked

fcntl = pytest.importorskip("fcntl")

HOLDER = """
import fcntl, sys, time
file = open(sys.argv[1], "a")
fcntl.flock(file, fcntl.LOCK_EX)
print("held", flush=True)
time.sleep(60)
"""


def test_another_process_is_refused_until_the_first_is_gone(tmp_path):
    command = [sys.executable, "-c", HOLDER, str(tmp_path / LOCK)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(UserError, match=r": another process is training in it; expected"), locked(tmp_path):
            raise AssertionError("entered")
        process.kill()
    for _ in range(2):
        with locked(tmp_path):
            assert os.listdir(tmp_path) == [LOCK]


def test_a_file_system_without_locks_gives_a_warning(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.warns(RuntimeWarning, match="cannot be locked .*: see to it"), locked(tmp_path):
        pass
    monkeypatch.setattr(locks, "fcntl", None)
    with pytest.warns(RuntimeWarning, match="no locks on this system"), locked(tmp_path):
        pass


def test_a_folder_that_cannot_be_written_to_is_reported(tmp_path):
    with pytest.raises(UserError, match=r"lock: cannot be written .*expected"), locked(tmp_path / "nonsuch"):
        raise AssertionError("entered")
