"""Whose picture is drawn next."""

import threading
import time

import pytest

from l2dgs_jax.viewer.turns import LEAST_INTERVAL, SHARPEN_AFTER, Turn, Turns


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def turns(clock):
    return Turns(clock)


def test_many_requests_give_one_picture(turns):
    for _ in range(5):
        turns.ask(1)
    assert turns.next() == (Turn(1, sharpen=False), None)
    assert turns.next() == (None, None)


def test_a_request_during_a_drawing_gives_another_picture_after_an_interval(turns, clock):
    turns.ask(1)
    turns.next()
    turns.ask(1)
    turn, wait = turns.next()
    assert turn is None
    assert wait == pytest.approx(LEAST_INTERVAL)
    clock.now += wait + 1e-6
    assert turns.next()[0] == Turn(1, sharpen=False)


def test_whoever_has_waited_longest_is_first(turns, clock):
    for guest in (3, 1, 2):
        turns.ask(guest)
        clock.now += 0.001
    turns.ask(3)  # asking again keeps the place in the queue
    assert [turns.next()[0].guest for _ in range(3)] == [3, 1, 2]


def test_pictures_are_sharpened_when_nothing_changes_and_nobody_waits(turns, clock):
    turns.ask(1)
    turns.next()
    turns.rest(1)
    turn, wait = turns.next()
    assert turn is None
    assert wait == pytest.approx(SHARPEN_AFTER)
    clock.now += SHARPEN_AFTER + 1e-6
    turns.ask(2)
    assert turns.next()[0] == Turn(2, sharpen=False)
    assert turns.next()[0] == Turn(1, sharpen=True)
    turns.rest(1)  # and sharper still, at once
    assert turns.next()[0] == Turn(1, sharpen=True)


def test_a_change_delays_sharpening(turns, clock):
    turns.ask(1)
    turns.next()
    turns.rest(1)
    clock.now += SHARPEN_AFTER - 0.01
    turns.ask(1)
    assert turns.next()[0] == Turn(1, sharpen=False)
    turns.rest(1)
    clock.now += SHARPEN_AFTER - 0.01
    assert turns.next()[0] is None


def test_a_guest_who_has_left_has_no_turn(turns):
    turns.ask(1)
    turns.leave(1)
    turns.rest(1)
    assert turns.next() == (None, None)


def test_waiting_ends_with_a_request_or_on_closing():
    turns, taken = Turns(), []
    thread = threading.Thread(target=lambda: [taken.append(turns.take()), taken.append(turns.take())])
    thread.start()
    turns.ask(7)
    while not taken:
        time.sleep(0.001)
    turns.close()
    thread.join(timeout=10)
    assert taken == [Turn(7, sharpen=False), None]
