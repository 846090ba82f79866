"""Signals as requests to stop."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from l2dgs_jax.runtime.signals import STOP_SIGNALS, stop_requests


@pytest.fixture(autouse=True)
def interrupts_enabled():
    """Needed where the tests run in the background of a shell, which ignores interrupts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_is_a_request_and_its_handler_is_restored(number):
    noticed, before = threading.Event(), signal.getsignal(number)
    with stop_requests(noticed.set) as stopping:
        assert stopping() is None
        os.kill(os.getpid(), number)
        assert noticed.wait(10)
        assert stopping() == number
        os.kill(os.getpid(), signal.SIGTERM)  # not taken for a second Ctrl-C, which ends the process
    assert signal.getsignal(number) == before
    assert signal.set_wakeup_fd(-1) == -1


def test_a_signal_of_the_program_around_is_no_request():
    before = signal.signal(signal.SIGUSR1, lambda *_: None)
    try:
        with stop_requests(lambda: None) as stopping:
            os.kill(os.getpid(), signal.SIGUSR1)
            os.kill(os.getpid(), signal.SIGTERM)
            while stopping() is None:
                time.sleep(0.001)
            assert stopping() == signal.SIGTERM
    finally:
        signal.signal(signal.SIGUSR1, before)


def test_an_ignored_signal_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with stop_requests(lambda: None) as stopping:
            os.kill(os.getpid(), signal.SIGINT)
            assert stopping() is None
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_second_interrupt_ends_the_process_at_once():
    """Even if Python cannot run a handler, as in a long compilation."""
    program = (
        "from l2dgs_jax.runtime.signals import stop_requests\n"
        "import hashlib\n"
        "with stop_requests(lambda: print('stopping', flush=True)):\n"
        "    print('ready', flush=True)\n"
        "    hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "stopping\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 128 + signal.SIGINT
